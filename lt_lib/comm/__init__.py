"""What is sent, how it travels, and who reads it (Sections Broadcast and anchor, Receiver, Route head)."""
