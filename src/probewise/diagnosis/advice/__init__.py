"""What to do next: what cannot be told apart, what the arm could do about it, and the scans that tell most."""
