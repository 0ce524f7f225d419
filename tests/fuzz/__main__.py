"""`python -m tests.fuzz [--seconds S] [NAME ...]`: coverage-guided fuzzing of each target, or of those named.

Each runs in a process of its own with a limit on its memory and on the time for one input, so that a crash, a hang or a
blow-up of native code underneath a reader is found as well. Inputs that led further are kept in .fuzz/NAME and start
the next round; one that breaks a target is left in .fuzz beside them, and ends the round with exit code 1. Needs the
extra `fuzz`.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

HOME = Path(".fuzz")
#: Longest time for one input, s, and most memory of one target, MiB.
_LIMITS = ("-timeout=20", "-rss_limit_mb=3000", "-max_len=65536")
#: Most memory that may be asked for beyond what a process has once everything is loaded, bytes.
_ROOM_BYTES = 1 << 30
#: Besides our own: readers in Python that ours hand files to.
_INSTRUMENTED = ("slam", "rosbags", "laspy", "pye57")
_ROOT = Path(__file__).resolve().parents[2]


def main(words: list[str]) -> int:
    """Fuzz, each target in a process of its own."""
    seconds = int(words.pop(words.index("--seconds") + 1)) if "--seconds" in words else 60
    wanted = [word for word in words if word != "--seconds"]
    if wanted[:1] == ["--one"]:
        return _fuzz(wanted[1], seconds)
    from tests.fuzz.targets import TARGETS

    unknown = [name for name in wanted if name not in TARGETS]
    if unknown:
        print(f"fuzz: expected names out of {', '.join(TARGETS)}, got {', '.join(unknown)}", file=sys.stderr)
        return 2
    broken = []
    for name in wanted or TARGETS:
        print(f"== {name}", flush=True)
        command = [sys.executable, "-m", "tests.fuzz", "--one", name, "--seconds", str(seconds)]
        if subprocess.run(command, check=False).returncode:
            broken.append(name)
    print(f"broken: {', '.join(broken)}" if broken else "nothing broke")
    return 1 if broken else 0


def _fuzz(name: str, seconds: int) -> int:
    import atheris  # type: ignore[import-not-found]

    with atheris.instrument_imports(include=list(_INSTRUMENTED), exclude=_compiled()):
        from tests.fuzz.targets import TARGETS
    target, corpus = TARGETS[name], HOME / name
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds()):
        (corpus / f"seed{number}").write_bytes(seed)
    with tempfile.TemporaryDirectory(prefix="spplanes-fuzz-") as scratch:
        for seed in target.seeds():
            target.run(seed, Path(scratch))  # compiles the kernels, which is no hang
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + _ROOM_BYTES,) * 2)
        options = [*_LIMITS, f"-max_total_time={seconds}", f"-artifact_prefix={HOME}/{name}-", "-print_final_stats=1"]
        atheris.Setup(["fuzz", *options, str(corpus)], lambda data: target.run(data, Path(scratch)) and None)
        atheris.Fuzz()
    return 0


def _compiled() -> list[str]:
    """Modules with kernels: numba cannot compile what is instrumented."""
    return [
        ".".join(path.relative_to(_ROOT).with_suffix("").parts)
        for path in (_ROOT / "slam").rglob("*.py")
        if "njit" in path.read_text(encoding="utf-8")
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
