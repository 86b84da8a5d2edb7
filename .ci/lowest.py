"""Print the lower bounds of all dependencies, the oldest versions that the project
claims to run with, for pip.
"""

import re
import tomllib
from itertools import chain
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())[
    "project"
]
requirements = chain(
    project["dependencies"], *project["optional-dependencies"].values()
)
for name, bound in sorted(
    re.findall(r"([\w-]+)(?:\[[\w,-]+\])?>=([\w.]+)", "\n".join(requirements))
):
    print(f"{name}=={bound}")
