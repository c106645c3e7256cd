"""Tasks of `probewise arm`, at the bench with the arm."""
