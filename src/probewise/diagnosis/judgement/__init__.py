"""What is believed: the test that nothing is missing, and the verdict."""
