"""A driven avatar in other programs: glTF, mesh sequences, textures."""
