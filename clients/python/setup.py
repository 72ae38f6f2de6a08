"""Generates the typed stubs before setuptools looks at the package; see pyproject.toml."""

import sys
from pathlib import Path

from setuptools import setup

# A build front end runs this file without its folder on the path.
sys.path.insert(0, str(Path(__file__).resolve().parent))

import generate  # noqa: E402

generate.up_to_date()
setup()
