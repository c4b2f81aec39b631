"""Files that are whole or not there, and safe reading of what may come from anywhere."""
