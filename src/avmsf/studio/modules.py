"""The page's libraries three and spark: from a local copy if there is one, otherwise from the network.

The import map of the page points to a content delivery network, at pinned versions. A copy that `fetch_modules` has
downloaded to the user's cache replaces these addresses, so that the page works without a network.
"""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

from avmsf.errors import StudioError
from avmsf.export.webpage import IMPORT_MAP

PINNED = {"three": "0.187.0", "@sparkjsdev/spark": "2.2.0"}
"""Packages of npm, and the one version of each that the page was tried with."""
MODULES_VARIABLE = "AVMSF_PAGE_MODULES"
"""Environment variable that names a folder node_modules to take before the cache."""
_REMOTE = re.compile(r"https://[^/]+/(?:npm/)?(?P<package>@?[^@]+)@(?P<version>[^/]+)/(?P<rest>.*)")
"""An address of a package's file on a content network."""
_SECONDS = 600.0
"""How long npm may take."""


def cache_folder() -> Path:
    """Return the folder of the user's copy of the libraries."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else Path.home() / ".cache") / "avmsf" / "page"


def find_modules() -> Path | None:
    """Return the folder node_modules that holds the pinned libraries; None where there is none.

    Raises StudioError where the environment names one that lacks them.
    """
    named = os.environ.get(MODULES_VARIABLE, "")
    folder = Path(named) if named else cache_folder() / "node_modules"
    lacking = [name for name, version in PINNED.items() if _version(folder / name) != version]
    if named and lacking:
        raise StudioError(
            f"{MODULES_VARIABLE}: expected a folder node_modules with "
            f"{', '.join(f'{name} {PINNED[name]}' for name in lacking)}, got {named}; run avmsf studio "
            "--fetch-modules and unset the variable",
            file=named,
            name=MODULES_VARIABLE,
            value=lacking,
        )
    return None if lacking else folder


def fetch_modules() -> Path:
    """Bring the pinned libraries into the user's cache by npm, and return their folder. Raises StudioError."""
    npm = shutil.which("npm")
    if npm is None:
        raise StudioError(
            "expected npm for --fetch-modules, got none; install Node.js, or leave the option out to load the "
            "libraries from a network",
            name="npm",
        )
    home = cache_folder()
    home.mkdir(parents=True, exist_ok=True)
    wanted = [f"{name}@{version}" for name, version in PINNED.items()]
    command = [npm, "install", "--prefix", str(home), "--ignore-scripts", "--no-audit", "--no-fund", *wanted]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise StudioError.expected(
            f"an end within {_SECONDS:g} s", _SECONDS, got="none", name="npm", advice="check the network and try again"
        ) from error
    found = find_modules() if done.returncode == 0 else None
    if found is None:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise StudioError(
            f"npm: expected {', '.join(wanted)}, got {lines[-1] if lines else 'no message'}; check the network and try "
            "again",
            name="npm",
            value=done.returncode,
        )
    return found


def with_local_modules(page: str) -> str:
    """Return the page's HTML with an import map that points to `modules/`. Raises StudioError."""
    found = IMPORT_MAP.findall(page)
    if len(found) != 1:
        raise StudioError(
            f"expected one import map in the page, got {len(found)}; install avmsf again",
            name="importmap",
            value=len(found),
        )
    imports = {name: _local(address) for name, address in json.loads(found[0][1])["imports"].items()}
    words = json.dumps({"imports": imports}, indent=2)
    return IMPORT_MAP.sub(lambda script: f"{script[1]}\n{words}\n{script[3]}", page)


def _local(address: str) -> str:
    """Return where the server has what the page would fetch from a network."""
    remote = _REMOTE.fullmatch(address)
    if remote is None:
        return address
    if PINNED.get(remote["package"]) != remote["version"]:
        raise StudioError(
            f"expected {', '.join(f'{name} {version}' for name, version in PINNED.items())} in the page, got "
            f"{address}; install avmsf again",
            name="importmap",
            value=address,
        )
    return f"./modules/{remote['package']}/{remote['rest']}"


def _version(package: Path) -> str | None:
    try:
        record = json.loads((package / "package.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record.get("version") if isinstance(record, dict) else None
