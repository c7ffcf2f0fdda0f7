"""Many runs in one command: what they are, who runs them, and how far they are. Used by `train sweep`."""
