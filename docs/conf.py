"""Configuration of the documentation: `make docs` builds it into build/docs."""

import sys
from importlib.metadata import version as installed_version
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))
from types_of_names import type_aliases

project = "faintfield"
author = "The faintfield developers"
copyright = author
version = release = installed_version("faintfield")

extensions = [
    "sphinx.ext.autodoc",
    "numpydoc",
    "myst_nb",  # Markdown by myst_parser, and notebooks
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "sphinx_codeautolink",
    "reference_pages",
    "repository_links",
]
# The notebooks in tutorials are made by sphinx-gallery, to download.
exclude_patterns = ["gallery", "failures", "_extensions", "tutorials/*/*.ipynb"]
default_role = "code"
smartquotes = False  # two hyphens are an option
nitpicky = True

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
numpydoc_show_class_members = False
# Types of other packages and aliases in signatures have no page.
nitpick_ignore_regex = [("py:class", r"(collections|cv2|msgspec|numpy|pathlib)\..*|\w+\[.*")]
nitpick_ignore = [("py:class", name) for name in type_aliases()]
# sphinx-gallery has linked the names of its examples already, and Sphinx removes the flags of doctests from others.
suppress_warnings = ["codeautolink.match_name", "codeautolink.match_block"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4

# An example whose package is not installed, because it is large, is shown without its picture.
_run = "plot_" if find_spec("deepinv") else "plot_(?!deepinv)"

sphinx_gallery_conf = {
    "examples_dirs": ["gallery", "failures"],
    "filename_pattern": _run,
    "ignore_pattern": "_scene",
    "within_subsection_order": "gallery_order.ReadingOrder",
    "gallery_dirs": ["tutorials/gallery", "tutorials/failures"],
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_signature": False,
    "write_computation_times": False,  # its page loads scripts from other hosts
}

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300

html_theme = "pydata_sphinx_theme"
html_title = "faintfield"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_theme_options = {
    "logo": {"text": "faintfield"},
    "navbar_align": "left",
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"index": []}
