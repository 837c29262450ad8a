"""The run store: every run is computed once, locally or on a cluster, and stored whole."""
