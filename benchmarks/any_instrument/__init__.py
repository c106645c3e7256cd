"""`probewise.Inquiry` beside optbayesexpt (NIST), reading by reading, on problems that a user of either would meet."""
