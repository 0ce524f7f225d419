"""Make a virtual environment with everything a make target needs, from nothing but Python and its standard library.

Usage: python bootstrap.py ENVIRONMENT_FOLDER [--dev]

`--dev` adds the test tools and Open3D, and looks after the system library that Open3D loads (libusb-1.0) and the
browser that the page of a run is tested in (Chromium).
"""

from __future__ import annotations

import ctypes.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent
MINIMUM = (3, 11)


def main(arguments: list[str]) -> int:
    """Create the environment named on the command line; exit code 2 when the machine lacks something."""
    if sys.version_info < MINIMUM:
        return refuse(f"spplanes needs Python 3.11 or newer, this is {sys.version.split()[0]}; set PYTHON=python3.x")
    environment, dev = Path(arguments[0]), "--dev" in arguments
    if not make_environment(environment):
        return refuse("python -m venv does not work here; on Debian or Ubuntu: apt-get install python3-venv")
    with ThreadPoolExecutor(1) as beside:  # the system's packages while Python's are installed
        system = beside.submit(look_after_the_system) if dev else None
        pip_install(environment, f"-e{PROJECT}" + ("[dev]" if dev else ""))
        if system is not None:
            system.result()
    return 0


def look_after_the_system() -> None:
    """Install what the tests need of the system, and say what could not be."""
    if not have(lambda: ctypes.util.find_library("usb-1.0"), "libusb-1.0-0"):
        print("Open3D needs the system library libusb-1.0, which could not be installed here; its tests are skipped.")
        print("On Debian or Ubuntu: sudo apt-get install libusb-1.0-0")
    if not have(lambda: shutil.which("chromedriver"), "chromium", "chromium-driver"):
        print("Chromium with its driver could not be installed here; the tests of a run's page are skipped.")
        print("On Debian or Ubuntu: sudo apt-get install chromium chromium-driver")


def refuse(sentence: str) -> int:
    """Say what is missing; the exit code for it."""
    print(sentence, file=sys.stderr)
    return 2


def python_of(environment: Path) -> Path:
    """The interpreter inside an environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def make_environment(environment: Path) -> bool:
    """Create the virtual environment if it is not there; Debian's Python may need a package for that first."""
    if works(environment):
        return True
    shutil.rmtree(environment, ignore_errors=True)
    create = [sys.executable, "-m", "venv", str(environment)]
    if subprocess.run(create, check=False).returncode == 0 and works(environment):
        return True
    shutil.rmtree(environment, ignore_errors=True)
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    installed = apt_install(f"python{version}-venv") or apt_install("python3-venv")
    return installed and subprocess.run(create, check=False).returncode == 0 and works(environment)


def works(environment: Path) -> bool:
    """Whether the environment has a working pip."""
    python = python_of(environment)
    return python.exists() and subprocess.run([python, "-m", "pip", "--version"], capture_output=True).returncode == 0


def have(find: Callable[[], str | None], *packages: str) -> bool:
    """Find something of the system, or install its packages where this user may."""
    return find() is not None or (all(map(apt_install, packages)) and find() is not None)


def apt_install(package: str) -> bool:
    """Install a Debian package when apt is here and we may use it; False otherwise."""
    if shutil.which("apt-get") is None:
        return False
    may = os.geteuid() == 0 or (
        shutil.which("sudo") is not None and subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0
    )
    if not may:
        return False
    prefix = [] if os.geteuid() == 0 else ["sudo", "-n"]
    settings = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    subprocess.run([*prefix, "apt-get", "update", "-qq"], check=False, env=settings, stdout=subprocess.DEVNULL)
    command = [*prefix, "apt-get", "install", "-y", "-qq", "--no-install-recommends", package]
    return subprocess.run(command, check=False, env=settings, stdout=subprocess.DEVNULL).returncode == 0


def pip_install(environment: Path, requirement: str) -> None:
    """Install with the versions of constraints.txt, so that tomorrow's environment is today's.

    What is imported is compiled to bytecode then: most of it never is.
    """
    constraints = str(PROJECT / "constraints.txt")
    command = [str(python_of(environment)), "-m", "pip", "install", "-q", "--no-compile", "--disable-pip-version-check"]
    subprocess.run([*command, "-c", constraints, requirement], check=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
