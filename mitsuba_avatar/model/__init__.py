"""The avatar's networks: encoder, localized conditioning, decoder, shadow branch, and the whole."""
