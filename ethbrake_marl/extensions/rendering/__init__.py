"""Show running episodes as pictures, as text, or in a window."""
