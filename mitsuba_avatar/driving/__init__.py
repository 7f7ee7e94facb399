"""What drives a finished avatar: signals from other sources, imputed latent codes, reconstruction from images."""
