"""Validated settings: what they share, one module per study, and the profiles that run_all.py gives to notebooks."""
