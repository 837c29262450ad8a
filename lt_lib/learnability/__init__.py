"""A scalar predictor of learnability (Section 'A scalar predictor'): the point-mass study and its sigmoid."""
