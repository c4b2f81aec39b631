"""The commands behind `pemviz`, one module each."""
