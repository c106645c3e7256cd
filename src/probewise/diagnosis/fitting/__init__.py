"""Models in coordinates with a standard normal prior (the null, a user's own model), and their fit."""
