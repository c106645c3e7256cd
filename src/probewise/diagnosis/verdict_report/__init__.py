"""The result of a diagnosis (`Diagnosis`), the verdict in one sentence, and diagnosis.json."""
