"""The result of a diagnosis (`Diagnosis`), the verdict in words, and diagnosis.json."""
