"""Rendered pixels under continuous control (Sections Route head, Rendered pixels): executor, bank, route heads."""
