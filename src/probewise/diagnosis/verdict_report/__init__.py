"""The `Diagnosis` value, the verdict in one sentence, and diagnosis.json."""
