"""What residuals say by themselves: whether something is missing, where, and what no name stands for."""
