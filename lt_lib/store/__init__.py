"""The run store: every run computed once, here or on a cluster, and kept whole."""
