"""A true Blender in a folder of its own: Debian's, in a chroot that needs neither mounts nor anything else of the host but debootstrap.

Debian keeps Blender 5.2 LTS in sid, which moves: what cannot be set up is `Unavailable`, with one sentence that says why.
debootstrap itself is installed only by those who ask for it: a developer's machine is the developer's.
"""

import os
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

SUITE = "sid"
# cattr is what Blender's extension system imports; xvfb is the display, with Mesa's software renderer.
PACKAGES = (
    "blender",
    "libgl1",
    "libegl1",
    "libgl1-mesa-dri",
    "xvfb",
    "python3-numpy",
    "python3-scipy",
    "python3-cattr",
    "python3-requests",
    "python3-zstandard",
)
STAMP = "tricap-packages.txt"
BLENDER = "Blender 5.2"
SPACE_BYTES = 2_500_000_000
SHARE = "share"


class Unavailable(Exception):
    """There can be no Blender window on this machine, and why."""


def set_up(root: Path, limit_s: float = 600.0, *, install: bool = False) -> Path:
    """Make the chroot in the folder `root` unless it is there and complete; about 3 minutes and 1.4 GB. Returns `root`.

    With `install`, debootstrap is installed by the system's package manager where it is missing.

    Raises:
        Unavailable: this machine, its user or its network do not allow it.
    """
    if os.name == "nt" or not hasattr(os, "geteuid") or os.geteuid() != 0:
        raise Unavailable("a chroot needs the rights of root")
    stamp = root / STAMP
    if stamp.is_file() and stamp.read_text().split() == list(PACKAGES):
        return root
    unfinished = root.with_name(root.name + ".unfinished")
    for folder in (unfinished, root):
        shutil.rmtree(folder, ignore_errors=True)
    try:
        _bootstrap(unfinished, limit_s, install)
        _install(unfinished, limit_s)
        (unfinished / STAMP).write_text("\n".join(PACKAGES) + "\n")
        unfinished.rename(root)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return root


def version(root: Path) -> str:
    """The first line of `blender --version` in the chroot, e.g. "Blender 5.2.2 LTS"."""
    asked = subprocess.run(["chroot", root, "blender", "--version"], capture_output=True, text=True, timeout=120)
    return next((line for line in asked.stdout.splitlines() if line.startswith("Blender")), "").strip()


def _bootstrap(root: Path, limit_s: float, install: bool) -> None:
    """Debian's smallest system in the folder `root`."""
    root.parent.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(root.parent).free
    if free < SPACE_BYTES:
        raise Unavailable(f"{root.parent} has {free / 1e9:.1f} GB free, and Blender's chroot needs {SPACE_BYTES / 1e9:.1f} GB")
    if shutil.which("debootstrap") is None:
        if not install:
            raise Unavailable("debootstrap is not installed (on Debian and Ubuntu: apt-get install debootstrap; --install does it)")
        _install_debootstrap(limit_s)
    _run(["debootstrap", "--variant=minbase", SUITE, root], f"debootstrap could not fetch Debian {SUITE}", limit_s)


def _install_debootstrap(limit_s: float) -> None:
    """By the system's own package manager. Its lists may be old, and where one source of several is ill, the others still serve."""
    if shutil.which("apt-get") is None:
        raise Unavailable("debootstrap is not installed, and there is no apt-get to install it")
    quiet = ["env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qy", "-o", "DPkg::Lock::Timeout=60"]
    with suppress(Unavailable):
        _run([*quiet, "update"], "apt-get update failed", limit_s)
    _run([*quiet, "install", "--no-install-recommends", "debootstrap"], "debootstrap could not be installed", limit_s)


def _install(root: Path, limit_s: float) -> None:
    """Blender and a display. The lists of packages are those that debootstrap just fetched."""
    shutil.copyfile("/etc/resolv.conf", root / "etc/resolv.conf")
    no_services = root / "usr/sbin/policy-rc.d"
    no_services.write_text("#!/bin/sh\nexit 101\n")
    no_services.chmod(0o755)
    install = ["chroot", root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "install", "-qy", "--no-install-recommends", *PACKAGES]
    _run(install, f"Debian {SUITE} could not install {PACKAGES[0]}", limit_s)
    _run(["chroot", root, "apt-get", "clean"], "apt-get clean failed", limit_s)
    found = version(root)
    if not found.startswith(BLENDER):
        raise Unavailable(f"Debian {SUITE} has {found or 'no Blender that runs'}, and the test is for {BLENDER}")


def _run(command: list, complaint: str, limit_s: float) -> None:
    """One step of the set-up, quietly; what it said last becomes part of the reason."""
    try:
        done = subprocess.run([str(part) for part in command], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise Unavailable(f"{complaint} within {limit_s:.0f} s") from None
    if done.returncode:
        said = [line.strip() for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        raise Unavailable(f"{complaint} ({next((s for s in said if s.startswith('E:')), said[-1] if said else 'no message')})")
