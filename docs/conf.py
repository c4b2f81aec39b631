"""How the documentation is built: ``docs/README.md`` says how to write and build it.

The theme is furo: all four parts stay in sight in one sidebar, it has a light and a dark look and
reads well on a telephone, and it takes the reader's own fonts. Nothing is asked of another host
when a page is read: MathJax comes with the site, and ``tests/docs/test_site.py`` looks for links
to scripts, styles and pictures elsewhere.
"""

import os
import sys
from pathlib import Path

from pemviz import __version__

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path.insert(0, str(DOCS / "_ext"))
# Notebooks call `pemviz` and `python`: those that build the site.
os.environ["PYTHONPATH"] = str(DOCS / "_ext")  # shell_cells
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"

project = "pemviz"
author = "The pemviz developers"
version = release = __version__
copyright = "the pemviz developers"
language = "en"

extensions = [
    "readable_types",  # before autodoc
    "commands",
    "settings",
    "result_fields",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["README.md", "_ext", "_static"]
nitpicky = False
smartquotes = False  # would make a dash of the two before an option

# MyST
myst_enable_extensions = [
    "amsmath",
    "attrs_block",
    "attrs_inline",
    "colon_fence",
    "deflist",
    "dollarmath",
    "fieldlist",
]
myst_heading_anchors = 4

# Notebooks: kept by their content, so that only what changed is carried out again. They run in a
# folder of their own and leave nothing in the checkout.
nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 180
nb_execution_in_temp = True
nb_execution_show_tb = True
nb_merge_streams = True
nb_ipywidgets_js = {}  # would be asked of another host

# Python
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 80
python_display_short_literal_types = True
autodoc_preserve_defaults = True
autoclass_content = "class"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# HTML
html_theme = "furo"
html_title = f"pemviz {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False
pygments_style = "tango"
pygments_dark_style = "monokai"
html_theme_options = {"navigation_with_keys": True}
copybutton_exclude = ".linenos, .gp, .go"
