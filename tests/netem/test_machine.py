"""Test the error messages on machines that cannot run a virtual network, and for users without permission."""

from __future__ import annotations

import asyncio
import os
import pwd
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

from netem import _namespaces
from netem.lab import Lab, LabUnavailable
from netem.lab_doctor import examine
from tests.machine import unavailable

REPOSITORY = Path(__file__).parents[2]


def run_as_nobody(argv: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command as an ordinary user. This is the present user, or the user `nobody` if the present user is root."""
    nobody = {"user": "nobody", "group": "nogroup", "extra_groups": []} if os.geteuid() == 0 else {}
    return subprocess.run(argv, capture_output=True, text=True, check=False, **nobody, **options)


def require_nobody_can() -> None:
    """Skip the test if only root can read the Python installation or this checkout."""
    probe = [sys.executable, "-c", "import netem.lab"]
    try:
        done = run_as_nobody(probe, env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(REPOSITORY)}, cwd="/")
    except PermissionError as error:
        pytest.skip(f"the user nobody cannot execute {error.filename}: {error.strerror}")
    if done.returncode != 0:
        message = (done.stderr.strip().splitlines() or ["it gave no reason"])[-1]
        pytest.skip(f"the user nobody cannot run {sys.executable} with this checkout: {message}")


def run_script(script: str, *, prefix: list[str] | None = None) -> subprocess.CompletedProcess[str]:
    """Run a Python script as an ordinary user, in a folder that this user may write."""
    require_nobody_can()
    folder = run_as_nobody(["mktemp", "-d"], cwd="/").stdout.strip()
    try:
        return run_as_nobody(
            [*(prefix or []), sys.executable, "-c", textwrap.dedent(script)],
            cwd=folder,
            env={"PATH": "/usr/bin:/bin", "HOME": folder, "PYTHONPATH": str(REPOSITORY), "TMPDIR": folder},
            timeout=120,
        )
    finally:
        subprocess.run(["rm", "-rf", folder], check=True)


_STORY = """
    import asyncio, os
    from pathlib import Path
    from netem.conditions import LinkConditions, NetworkConditions
    from netem.lab import Lab

    async def main():
        here = Path.cwd()
        async with await Lab.open([1, 2], log=here / "lab.log") as lab:
            applied = await lab.apply(NetworkConditions(LinkConditions(0.25)).with_partition([[1]]))
            print(os.geteuid(), applied.receivers[1].loss, applied.receivers[1].cut_from)
            process = await lab.spawn(1, ["/bin/true"], cwd=here, env={}, stdout=here / "o", stderr=here / "o")
            print(await process.wait(), (here / "o").stat().st_uid)

    asyncio.run(main())
"""


@pytest.mark.lab
def test_ordinary_user_can_open_a_lab() -> None:
    done = run_script(_STORY)
    user = os.geteuid() or pwd.getpwnam("nobody").pw_uid
    assert done.stdout.splitlines() == [f"{user} 0.25 (2,)", f"0 {user}"], done.stderr


_EXPECT_REFUSAL = """
    import asyncio
    from pathlib import Path
    from netem.lab import Lab, LabUnavailable
    from netem.lab_doctor import examine

    try:
        asyncio.run(Lab.open([1, 2], log=Path("lab.log")))
    except LabUnavailable as error:
        print(error.stage)
        print(error.way_out)
        print(error)
    for finding in examine():
        print(finding.name, finding.ok, finding.way_out)
"""


@pytest.mark.lab
def test_forbidden_user_namespaces_are_reported_with_the_remedy() -> None:
    # A user namespace may forbid further ones inside it, as an administrator does for a machine. Root's
    # rights are taken away too, for root needs no user namespace.
    done = run_script(
        _EXPECT_REFUSAL,
        prefix=["unshare", "--user", "--map-root-user", "sh", "-c",
                'echo 0 > /proc/sys/user/max_user_namespaces && exec setpriv --bounding-set=-all "$@"', "sh"],
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert lines[0] == "namespaces", done.stderr
    assert "sudo sysctl user.max_user_namespaces=15000, or run as root" in lines[1]
    assert lines[2].startswith("This machine does not allow private networks (unshare:")
    assert lines[3].startswith("namespaces False User namespaces are switched off")


_INTERPRETER_OUT_OF_REACH = """
    import asyncio, sys
    from pathlib import Path
    from netem.lab_doctor import examine
    from netem.lab import Lab, LabUnavailable

    program = Path("program")
    program.touch(0o600)
    sys.executable = str(program.absolute())
    try:
        asyncio.run(Lab.open([1, 2], log=Path("lab.log")))
    except LabUnavailable as error:
        print(error)
    print([(finding.name, finding.ok) for finding in examine()])
"""


@pytest.mark.lab
def test_unreachable_interpreter_is_named_as_the_only_cause() -> None:
    done = run_script(_INTERPRETER_OUT_OF_REACH)
    said, findings = done.stdout.splitlines()
    user = pwd.getpwuid(os.geteuid() or pwd.getpwnam("nobody").pw_uid).pw_name
    assert said.startswith(f"The lab's first process cannot be started: user {user} cannot execute /"), done.stderr
    assert "/program (Permission denied). Let that user reach it" in said
    assert findings == "[('namespaces', True), ('network', False)]"


@pytest.mark.lab
def test_program_that_a_user_cannot_execute_is_named_with_the_user() -> None:
    done = run_script(_STORY.replace('["/bin/true"]', '["/etc/shadow"]'))
    assert "The program cannot be started: [Errno 13] Permission denied to user" in done.stderr
    assert done.stderr.rstrip().endswith(": '/etc/shadow'")


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("user/max_user_namespaces", 0, "user.max_user_namespaces=15000"),
        ("user/max_net_namespaces", 0, "user.max_net_namespaces=15000"),
        ("kernel/unprivileged_userns_clone", 0, "kernel.unprivileged_userns_clone=1"),
        ("kernel/apparmor_restrict_unprivileged_userns", 1, "kernel.apparmor_restrict_unprivileged_userns=0"),
    ],
)
def test_each_restriction_of_namespaces_has_its_own_remedy(
    monkeypatch: pytest.MonkeyPatch, name: str, value: int, expected: str
) -> None:
    monkeypatch.setattr(_namespaces, "_sysctl", lambda asked: value if asked == name else None)
    assert expected in _namespaces.way_out("unshare: unshare failed: Operation not permitted")


def test_missing_tool_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LabUnavailable, match=r"setpriv is not installed\. Install util-linux"):
        asyncio.run(Lab.open([1], log=tmp_path / "lab.log"))
    assert [(finding.name, finding.ok) for finding in examine()] == [("namespaces", False)]


@pytest.mark.lab
def test_missing_engine_is_refused_with_the_remedy() -> None:
    for engine in ("netem", "nftables"):
        if (error := unavailable(engine)) is not None:
            assert error.stage == "engine"
            assert f"No engine {engine} works here" in str(error)
            assert {"netem": "sch_netem", "nftables": "apt install nftables"}[engine] in error.way_out
            return
    pytest.skip("this kernel has both engines")


@pytest.mark.lab
def test_doctor_agrees_with_the_engines_of_a_lab() -> None:
    findings = {finding.name: finding for finding in examine()}
    assert [*findings] == ["namespaces", "network", "netem", "nftables", "engine", "shared channel"]
    assert findings["shared channel"].ok
    assert all(finding.ok for finding in findings.values() if finding.needed)
    for engine in ("netem", "nftables"):
        assert findings[engine].ok == (unavailable(engine) is None)
        assert bool(findings[engine].way_out) == (unavailable(engine) is not None)
