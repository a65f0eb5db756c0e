"""The figures and the evaluation of [NIST], one script each."""
