"""What is said of it: the Diagnosis value, the verdict in one sentence, diagnosis.json."""
