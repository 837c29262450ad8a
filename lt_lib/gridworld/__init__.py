"""The gridworld (Sections Setup, Gridworld): map, patch encoder, receiver trained by MAPPO, corruption."""
