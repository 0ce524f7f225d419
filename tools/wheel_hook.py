"""What hatchling is told of a wheel: with SPPLANES_KERNELS set it brings compiled kernels, for one Python and system.

`make wheel` sets it. It needs what the packages need at run time, so it is not for an isolated build.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CompiledKernels(BuildHookInterface):
    """SPPLANES_KERNELS names jobs of `tools/compile_kernels.py`, or `all`."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and put the result into the wheel."""
        wanted = os.environ.get("SPPLANES_KERNELS", "")
        if self.target_name != "wheel" or version != "standard" or not wanted:
            return
        root = Path(self.root)
        folder = root / "build" / "compiled"
        shutil.rmtree(folder, ignore_errors=True)
        names = [] if wanted == "all" else [f"--run={name}" for name in wanted.split(",")]
        program = [sys.executable, str(root / "tools" / "compile_kernels.py")]
        subprocess.run([*program, f"--into={folder}", *names], check=True)
        for file in sorted(folder.rglob("*.nb?")):
            build_data["force_include"][str(file)] = f"spplanes/_compiled/{file.relative_to(folder).as_posix()}"
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
