"""Learning an avatar from a capture: losses, the loop, checkpoints."""
