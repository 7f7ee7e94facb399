"""What a trained avatar has learnt, beyond how near its pictures are: disentanglement, local effects, uncertainty, gain in geometry."""
