"""Sphinx configuration: ``sphinx-build -W -b html docs docs/_build/html`` builds the pages."""

import os
import subprocess
import sys
from importlib.metadata import version as installed
from pathlib import Path

project = "illumgrid"
author = "The illumgrid authors"
copyright = "2026, The illumgrid authors"
version = release = installed("illumgrid")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "myst_parser",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "examples"]

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

autosummary_generate = True
autodoc_typehints = "none"  # the numpydoc sections give the types, with shapes and units
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "ignore_pattern": r"gallery_fields\.py|__init__\.py",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
    "min_reported_time": 1e9,
    "capture_repr": (),
}

live = Path(__file__).parent / "live"  # pages that the gallery writes, copied unchanged into the site
live.mkdir(exist_ok=True)
html_extra_path = ["live"]

html_theme = "pydata_sphinx_theme"
html_title = "illumgrid"
html_show_sourcelink = False
html_theme_options = {
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}

# The page of the stages shows what the command says, on the day that the pages are built.
listing = Path(__file__).parent / "api" / "generated" / "stages.txt"
listing.parent.mkdir(parents=True, exist_ok=True)
command = [sys.executable, "-m", "illumgrid", "plugins"]
listing.write_bytes(subprocess.check_output(command, env={**os.environ, "ILLUMGRID_DISABLE_PLUGINS": "1"}))
