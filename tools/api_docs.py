"""Build the API documentation with pdoc; any warning fails.

python tools/api_docs.py OUTPUT_FOLDER
"""

import pkgutil
import sys
import warnings
from pathlib import Path

import pdoc

import pemviz
import pemviz.recording


def build(output: Path) -> int:
    """Document the whole package and return how many pages there are."""
    for package in (pemviz, pemviz.recording):  # pdoc does not see names that are still to come
        for name in package.__all__:
            setattr(package, name, getattr(package, name))
    pdoc.render.configure(docformat="google", show_source=True)
    parts = [part.name for part in pkgutil.iter_modules(pemviz.__path__)]
    pemviz.__all__.extend(part for part in parts if part != "__main__")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pdoc.pdoc("pemviz", output_directory=output)
    return len(list(output.rglob("*.html")))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python tools/api_docs.py OUTPUT_FOLDER")
    print(f"{build(Path(sys.argv[1]))} pages in {sys.argv[1]}")
