"""What is fitted: the null and a user's own model in coordinates of standard normal prior, and the fit itself."""
