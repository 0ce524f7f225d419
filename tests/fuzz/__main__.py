"""`python -m tests.fuzz [--seconds S] [NAME ...]`: coverage-guided fuzzing of each target, or of those named.

Everything is loaded once; each target then runs for S seconds of processor time in a process of its own, with a limit
on its memory and on the processor time for one input, so that a crash, a hang or a blow-up of native code underneath a
reader is found as well, and a busy machine is not taken for a hang. Inputs that led further are kept in .fuzz/NAME and
start the next round; one that breaks a target is left in .fuzz beside them, and the exit code is 1. What each target
had is added to .fuzz/log.jsonl. Needs the extra `fuzz`.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.fuzz.target import Target

HOME = Path(".fuzz")
#: Most processor time for one input, s; the limit in wall time is for a process that sleeps.
_INPUT_S, _ASLEEP_S = 20, 600
#: Most memory of one target, MiB, and longest input, bytes.
_LIMITS = (f"-timeout={_ASLEEP_S}", "-rss_limit_mb=3000", "-max_len=65536")
#: Most memory that may be asked for beyond what a process has once everything is loaded, bytes.
_ROOM_BYTES = 1 << 30
#: Besides our own: readers in Python that ours hand files to.
_INSTRUMENTED = ("slam", "rosbags", "laspy", "pye57")
#: Share of inputs that are changed blindly, byte by byte.
_BLIND = 0.4
_ROOT = Path(__file__).resolve().parents[2]
#: A disk in memory, where there is one: most of what is fuzzed are files.
_FAST = next((path for path in ("/dev/shm",) if os.access(path, os.W_OK)), None)


def main(words: list[str]) -> int:
    """Fuzz, each target in a process of its own."""
    seconds = float(words.pop(words.index("--seconds") + 1)) if "--seconds" in words else 60.0
    wanted = [word for word in words if word != "--seconds"]
    targets = _loaded()
    unknown = [name for name in wanted if name not in targets]
    if unknown:
        print(f"fuzz: expected names out of {', '.join(targets)}, got {', '.join(unknown)}", file=sys.stderr)
        return 2
    broken = [name for name in wanted or targets if not _holds(targets[name], seconds)]
    print(f"broken: {', '.join(broken)}" if broken else "nothing broke")
    return 1 if broken else 0


def _loaded() -> dict[str, Target]:
    """The targets, with what they read instrumented."""
    import atheris  # type: ignore[import-not-found]

    with atheris.instrument_imports(include=list(_INSTRUMENTED), exclude=_compiled()):
        from tests.fuzz.targets import TARGETS
    from tests.fuzz.remembering import remember_compiled_messages

    remember_compiled_messages()
    return TARGETS


def _holds(target: Target, seconds: float) -> bool:
    """Fuzz one target; whether it held."""
    corpus = HOME / target.name
    corpus.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="spplanes-fuzz-", dir=_FAST) as name:
        scratch = Path(name)
        for number, seed in enumerate(target.seeds()):
            (corpus / f"seed{number}").write_bytes(seed)
            target.run(seed, scratch)  # compiles the kernels, which is no hang
        output = HOME / f"{target.name}.txt"
        child = os.fork()
        if child == 0:
            _fuzz(target, seconds, corpus, scratch, output)
        _, status, used = os.wait4(child, 0)
        if status and os.WIFSIGNALED(status):  # too long for one input, or killed: libFuzzer had no say
            left = [one.rename(one.with_name(f"left{number}")) for number, one in enumerate(scratch.glob("input*"))]
            if _breaks_again(target, left, scratch):
                for one in left:
                    name = f"{target.name}-{signal.Signals(os.WTERMSIG(status)).name}-{int(time.time())}"
                    shutil.copy(one, HOME / name)
            else:
                status = 0  # the time went into compiling kernels that no seed needs
    said = output.read_text(encoding="utf-8", errors="replace")
    runs = [int(line.split()[-1]) for line in said.splitlines() if line.startswith("stat::number_of_executed_units")]
    row = {"name": target.name, "cpu_s": round(used.ru_utime + used.ru_stime, 1), "runs": sum(runs), "status": status}
    with (HOME / "log.jsonl").open("a", encoding="utf-8") as log:
        log.write(json.dumps(row) + "\n")
    print(f"{row['name']}: {row['runs']} inputs in {row['cpu_s']} s{'' if status == 0 else f', broken: {output}'}")
    return status == 0


def _breaks_again(target: Target, files: list[Path], scratch: Path) -> bool:
    """Whether one of these files is too much a second time."""
    child = os.fork()
    if child == 0:
        with (scratch / "said").open("wb") as stream:
            os.dup2(stream.fileno(), 2)
        for file in files:
            signal.setitimer(signal.ITIMER_PROF, _INPUT_S)
            with suppress(ValueError):
                target.read(Path(shutil.copy(file, scratch / f"input{target.suffix}")))
        os._exit(0)
    return os.waitpid(child, 0)[1] != 0


def _fuzz(target: Target, seconds: float, corpus: Path, scratch: Path, output: Path) -> None:
    """In a process of its own; does not return."""
    import atheris  # type: ignore[import-not-found]

    from tests.fuzz.mutating import by_form, floats

    with output.open("wb") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + _ROOM_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    tempfile.tempdir = str(scratch)
    end = time.process_time() + seconds

    def one(data: bytes) -> Any:
        if time.process_time() > end:
            os.kill(os.getpid(), signal.SIGUSR1)  # libFuzzer says what it did and ends
        signal.setitimer(signal.ITIMER_PROF, _INPUT_S)
        target.run(data, scratch)
        signal.setitimer(signal.ITIMER_PROF, 0.0)

    def changed(data: bytes, most: int, seed: int) -> bytes:
        random = Random(seed)
        if random.random() < _BLIND:
            return atheris.Mutate(data, most)
        return (floats if target.is_numbers else by_form)(data, random)[:most]

    options = [*_LIMITS, f"-artifact_prefix={HOME}/{target.name}-", "-print_final_stats=1"]
    atheris.Setup(["fuzz", *options, str(corpus)], one, custom_mutator=changed)
    atheris.Fuzz()
    os._exit(0)


def _compiled() -> list[str]:
    """Modules with kernels: numba cannot compile what is instrumented."""
    return [
        ".".join(path.relative_to(_ROOT).with_suffix("").parts)
        for path in (_ROOT / "slam").rglob("*.py")
        if "njit" in path.read_text(encoding="utf-8")
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
