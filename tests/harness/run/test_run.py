"""Test runs with real processes and namespaces, and the errors that a user can cause."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.harness.command import COMMAND, DEADLINE_S, Running, harness, processes, sentences, write_scenario
from tests.harness.unsupported import lacking, refusing_to_start

pytestmark = pytest.mark.lab


def verdicts(record: dict[str, Any]) -> dict[str, str]:
    return {number: one["verdict"] for number, one in record["characteristics"].items()}


def test_run_with_vehicles_writes_all_files(tmp_path: Path) -> None:
    scenario = write_scenario(
        tmp_path,
        speedup=50,  # on a busy machine agents log late, and must still fill a block
        events={"source": "random", "mean_s": 4},
        network={"loss": 0.1},
        timeline=[{"at_s": 50, "partition": [[1]]}, {"at_s": 100, "heal": True}],
        vehicles={"kind": "embedded"},
        final_reconcile=True,
    )
    out = tmp_path / "run"
    done = harness("run", scenario, "--seed", 7, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads((out / "run.json").read_text())
    assert record["schema"] == "ucp-run/1"
    assert record["outcome"] == "completed"
    assert record["seed"] == 7
    assert set(verdicts(record).values()) == {"holds"}
    assert record["figures"]["blocks"] > 0
    assert record["figures"]["bytes"] > 0
    assert [change["what"] for change in record["network"]] == ["start", "partition", "heal", "final reconcile"]
    assert record["final_reconcile"]["complete"]
    assert all(vehicle["armed"] for vehicle in record["vehicles"].values())
    for agent in (1, 2, 3):
        assert {path.name for path in (out / "agents").glob(f"{agent}.*")} == {
            f"{agent}.{end}" for end in ("chain.json", "trace.jsonl", "log", "mission.json")
        }
        assert (out / "vehicles" / str(agent) / "telemetry.tlog").stat().st_size > 1000
    network = [json.loads(line) for line in (out / "network.jsonl").read_text().splitlines()]
    partition = next(change for change in network if change["what"] == "partition")
    assert partition["applied"]["receivers"]["1"]["cut_from"] == [2, 3]
    assert partition["applied"]["receivers"]["2"]["loss"] == pytest.approx(0.1)
    assert "<html" in (out / "report.html").read_text()
    assert not processes(out)
    assert "one uniform chain" in done.stdout
    again = harness("check", out, "--json")
    assert json.loads(again.stdout)["characteristics"] == record["characteristics"]
    assert json.loads(again.stdout)["figures"] == record["figures"]


@pytest.mark.any_user
def test_partition_without_heal_makes_5_and_6_not_applicable(tmp_path: Path) -> None:
    scenario = write_scenario(
        tmp_path,
        agents=[7, 300, 65535],
        duration_s=400,
        timeline=[{"at_s": 0, "partition": [[7], [300, 65535]]}],
        vehicles={"kind": "none"},
        events={"mean_s": 10},
    )
    done = harness("run", scenario, "--seed", 3, "--out", tmp_path / "run")
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert done.returncode == 0, done.stdout + done.stderr
    assert verdicts(record) == {**dict.fromkeys("1234", "holds"), **dict.fromkeys("56", "not applicable")}
    assert "partition 7 | 300 65535" in record["characteristics"]["6"]["reason"]
    seven = json.loads((tmp_path / "run" / "agents" / "7.chain.json").read_text())
    assert {block["agent_id"] for block in seven["chain"]} == {7}
    other = json.loads((tmp_path / "run" / "agents" / "300.chain.json").read_text())
    assert {block["agent_id"] for block in other["chain"]} == {300, 65535}


@pytest.mark.any_user
def test_command_line_options_override_the_scenario(tmp_path: Path) -> None:
    scenario = write_scenario(tmp_path, speedup=1)
    done = harness("run", scenario, "--speedup", 200, "--vehicles", "none", "--seed", 0, "--out", tmp_path / "run")
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert done.returncode == 0
    assert record["scenario"]["speedup"] == 200
    assert record["vehicles"] == {}
    assert record["wall_s"] < 200, "the mission takes 200 s at the speedup of the scenario"


def test_ctrl_c_ends_the_run_with_exports_and_verdicts(tmp_path: Path) -> None:
    run = Running(write_scenario(tmp_path, duration_s=100_000), tmp_path / "run")
    run.wait_for_mission(1, 2, 3)
    run.process.send_signal(signal.SIGINT)
    status, _, err = run.end()
    assert status == 130
    (said,) = sentences(err)
    assert said.startswith("the run was interrupted at mission second")
    record = run.record()
    assert record["outcome"] == "interrupted"
    assert record["characteristics"]["3"]["verdict"] == "holds"
    assert len(list((run.out / "agents").glob("*.chain.json"))) == 3
    assert (run.out / "report.html").exists()
    assert not processes(run.out)


@pytest.mark.any_user
def test_crashed_agent_ends_the_run_and_the_others_export(tmp_path: Path) -> None:
    run = Running(write_scenario(tmp_path, duration_s=100_000, vehicles={"kind": "none"}), tmp_path / "run")
    run.wait_for_mission(1, 2, 3)
    run.signal_agent(2, signal.SIGKILL)
    status, _, err = run.end()
    assert status == 1
    assert sentences(err)[0] == (
        "agent 2 ended by itself with SIGKILL; its log is agents/2.log; the chains and traces that were written are "
        "checked"
    )
    record = run.record()
    assert record["agents"]["2"]["outcome"] == "crashed"
    assert record["agents"]["1"]["outcome"] == record["agents"]["3"]["outcome"] == "exported"
    assert "ready" in (run.out / "agents" / "2.log").read_text()
    assert record["characteristics"]["6"]["verdict"] == "not applicable"
    assert "agent 2" in record["characteristics"]["6"]["reason"]


@pytest.mark.any_user
def test_hanging_agent_ends_the_run_and_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Running(write_scenario(tmp_path, duration_s=100_000, vehicles={"kind": "none"}), tmp_path / "run")
    run.wait_for_mission(1, 2, 3)
    run.signal_agent(3, signal.SIGSTOP)
    status, _, err = run.end()
    assert status == 1
    assert re.match("agent 3 stopped answering: no answer to status within", sentences(err)[0])
    assert run.record()["agents"]["3"]["outcome"] == "hung"
    assert not processes(run.out)


def executable(path: Path, text: str, mode: int = 0o755) -> Path:
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.any_user
def test_unusable_vehicle_binary_is_refused_before_the_start(tmp_path: Path) -> None:
    not_executable = executable(tmp_path / "arducopter", "#!/bin/sh\n", 0o644)
    for binary, sentence in ((tmp_path / "nowhere", "does not exist"), (not_executable, "is not executable")):
        scenario = write_scenario(tmp_path, vehicles={"kind": "ardupilot", "binary": str(binary)})
        done = harness("run", scenario, "--out", tmp_path / f"run-{sentence[:4]}{len(sentence)}")
        assert done.returncode == 2
        (said,) = sentences(done.stderr)
        assert sentence in said
        assert str(binary) in said
    assert not list(tmp_path.glob("run-*"))


@pytest.mark.any_user
def test_missing_ardupilot_is_refused_with_a_solution(tmp_path: Path) -> None:
    environment = {**os.environ, "PATH": "/usr/bin:/bin"}
    environment.pop("ARDUPILOT_SITL", None)
    done = harness(
        "run", write_scenario(tmp_path), "--vehicles", "ardupilot", "--out", tmp_path / "run", env=environment
    )
    assert done.returncode == 3
    assert "no ArduPilot" in sentences(done.stderr)[0]


@pytest.mark.any_user
def test_vehicle_that_exits_at_once_ends_the_run_with_its_output(tmp_path: Path) -> None:
    binary = executable(tmp_path / "arducopter", "#!/bin/sh\necho bind failed >&2\nexit 1\n")
    scenario = write_scenario(tmp_path, vehicles={"kind": "ardupilot", "binary": str(binary)})
    done = harness("run", scenario, "--out", tmp_path / "run")
    assert done.returncode == 2
    said = sentences(done.stderr)[0]
    assert re.search(r"vehicle \d \(ardupilot\) ended by itself with status 1; its last output .*: bind failed", said)
    assert not processes(tmp_path / "run")


@pytest.mark.any_user
def test_run_directory_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "precious").write_text("data")
    done = harness("run", write_scenario(tmp_path), "--out", tmp_path / "run")
    assert done.returncode == 2
    assert "is not empty: choose another --out" in sentences(done.stderr)[0]
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["precious"]


@pytest.mark.any_user
def test_simultaneous_runs_do_not_receive_each_other(tmp_path: Path) -> None:
    runs = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        scenario = write_scenario(tmp_path / name, vehicles={"kind": "none"}, duration_s=300)
        runs.append(Running(scenario, tmp_path / name / "run", "--seed", 1))
    for run in runs:
        status, out, err = run.end()
        assert status == 0, out + err
        assert {agent["dropped"].get("sender not on the roster", 0) for agent in run.record()["agents"].values()} == {0}


def test_full_disk_gives_status_3_and_keeps_written_files(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, events={"mean_s": 1}, duration_s=100_000)
    script = """
import os, pathlib, signal, subprocess, sys, time
sys.path.insert(0, sys.argv[3])
from tests.harness.command import Running
disk, scenario = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk], check=True)
run = Running(scenario, disk / "run")
run.wait_for_mission(1, 2, 3)
try:
    with (disk / "ballast").open("wb", buffering=0) as ballast:
        while ballast.write(bytes(4096)) == 4096: pass
except OSError: pass
run.process.send_signal(signal.SIGINT)
status, out, err = run.end()
print(out, err)
traces = list((disk / "run" / "agents").glob("*.trace.jsonl"))
assert len(traces) == 3 and all(path.read_text().endswith("\\n") for path in traces)
assert not list(disk.rglob(".*.tmp")), "a temporary file is left"
sys.exit(status)
"""
    private = ["unshare", "--user", "--map-root-user", "--mount"]
    done = subprocess.run(
        [*private, sys.executable, "-c", script, str(disk), str(scenario), str(Path(__file__).parents[3])],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )
    assert "Traceback" not in done.stdout + done.stderr, done.stdout + done.stderr
    assert done.returncode == 3, done.stdout + done.stderr
    assert "No space left on device" in done.stdout


def test_forbidden_user_namespaces_give_status_3_in_run_and_doctor(tmp_path: Path) -> None:
    # A user namespace can forbid further ones inside it, as an administrator can for a machine. The capabilities of
    # root are dropped, because root needs no user namespace.
    forbid = 'echo 0 > /proc/sys/user/max_user_namespaces && exec setpriv --bounding-set=-all "$@"'
    forbidden = ["unshare", "--user", "--map-root-user", "sh", "-c", forbid, "sh"]
    for command in (["run", write_scenario(tmp_path), "--out", tmp_path / "run"], ["doctor"]):
        done = subprocess.run(
            [*forbidden, *COMMAND, *map(str, command)], capture_output=True, text=True, timeout=DEADLINE_S
        )
        assert done.returncode == 3
        assert "sysctl user.max_user_namespaces=15000, or run as root" in " ".join((done.stdout + done.stderr).split())
        assert "Traceback" not in done.stderr
    assert json.loads((tmp_path / "run" / "run.json").read_text())["outcome"] == "failed"


@pytest.mark.any_user
def test_any_program_that_follows_the_contract_can_be_tested(tmp_path: Path) -> None:
    agent = executable(
        tmp_path / "my-agent",
        f"#!/bin/sh\necho $1 >>'{tmp_path}/started'\nexec {shlex.quote(sys.executable)} -m ucp.node \"$2\"\n",
    )
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, agent_command=[str(agent), "--mine"])
    done = harness("run", scenario, "--seed", 1, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "started").read_text() == "--mine\n" * 3


@pytest.mark.any_user
def test_some_agents_run_another_program(tmp_path: Path) -> None:
    agent = tmp_path / "my agent.py"
    agent.write_text(
        f"""
import sys
import ucp.node
open({str(tmp_path / "started")!r}, "a").write(sys.argv[1])
class Mine(ucp.node.Node):
    def _status(self, request):
        return {{**super()._status(request), "version": "mine\\n1.4"}}
sys.exit(ucp.node.main(sys.argv[1:], Mine))
"""
    )
    commands = {2: [sys.executable, os.path.relpath(agent)]}
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, agent_command=commands)
    done = harness("run", scenario, "--seed", 1, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "started").read_text() == "2.mission.json"
    left = json.loads((tmp_path / "run" / "run.json").read_text())["agents"]
    assert (left["1"]["version"], left["2"]["version"]) == (None, "mine 1.4")
    interpreter, file = left["2"]["command"]
    assert (interpreter, Path(file).resolve()) == (sys.executable, agent.resolve())
    who = f"agents 1, 3 ran the harness's own; agent 2 ran {shlex.join(commands[2])} (mine 1.4)"
    assert who in done.stdout
    assert who in harness("check", tmp_path / "run").stdout
    assert f"in both runs {who}\n" in harness("diff", tmp_path / "run", tmp_path / "run").stdout
    assert "(mine 1.4)" in (tmp_path / "run" / "report.html").read_text()
    ran = json.loads(harness("check", tmp_path / "run", "--json").stdout)["programs"]
    assert [(program["agents"], program["version"]) for program in ran] == [([1, 3], None), ([2], "mine 1.4")]


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (["./nowhere"], "`agent_command`: ./nowhere is not a program: give a path from {here}, or a name on PATH"),
        (
            {3: ["./nowhere"]},
            "`agent_command` of agent 3: ./nowhere is not a program: give a path from {here}, or a name on PATH",
        ),
        (
            {3: ["{notes}"]},
            "`agent_command` of agent 3: {notes} is not executable: make it executable (chmod +x), or put ",
        ),
        (
            {3: ["{script}"]},
            "`agent_command` of agent 3: the first line of {script} names /no/such, which does not exist",
        ),
        ({3: ["/usr"]}, "`agent_command` of agent 3: /usr is not a program: give a path, or a name on PATH"),
    ],
)
@pytest.mark.any_user
def test_missing_agent_program_is_refused_before_the_start(tmp_path: Path, command: Any, sentence: str) -> None:
    notes = tmp_path / "notes.txt"
    notes.touch()
    script = executable(tmp_path / "script", "#!/no/such interpreter\n")
    asked = json.loads(json.dumps(command).replace("{notes}", str(notes)).replace("{script}", str(script)))
    done = harness("run", write_scenario(tmp_path, agent_command=asked), "--out", tmp_path / "run")
    assert done.returncode == 2
    assert sentences(done.stderr)[0].startswith(sentence.format(notes=notes, script=script, here=Path.cwd()))
    assert not (tmp_path / "run").exists()


def test_file_that_cannot_be_executed_is_a_scenario_error(tmp_path: Path) -> None:
    agent = executable(tmp_path / "my-agent", "no program\n")
    done = harness(
        "run", write_scenario(tmp_path, agent_command={3: [str(agent), "[/bold]"]}), "--out", tmp_path / "run"
    )
    assert done.returncode == 2
    assert "`agent_command` of agent 3: The agent cannot be started: [Errno 8] Exec format error" in done.stderr
    assert "agent 3 ran" in done.stdout and "[/bold]" in done.stdout


@pytest.mark.any_user
def test_agent_that_ends_at_once_is_named_with_its_status(tmp_path: Path) -> None:
    agent = executable(tmp_path / "my-agent", "#!/bin/sh\necho no licence >&2\nexit 4\n")
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, agent_command=[str(agent)])
    done = harness("run", scenario, "--out", tmp_path / "run")
    assert done.returncode == 1
    assert re.match(r"agent \d ended by itself with status 4; its log is agents/\d\.log", sentences(done.stderr)[0])
    assert (tmp_path / "run" / "agents" / "1.log").read_text() == "no licence\n"


@pytest.mark.parametrize("words", ["mine has no telemetry", ""])
@pytest.mark.any_user
def test_agent_that_ends_with_127_at_its_start_is_not_judged(tmp_path: Path, words: str) -> None:
    agent = refusing_to_start(tmp_path / "my-agent", words)
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, agent_command={2: [str(agent), "--x"]})
    done = harness("run", scenario, "--out", tmp_path / "run")
    assert done.returncode == 3
    why = f"not supported by agent 2 ({shlex.quote(str(agent))} --x): {words or 'it does not say why'}"
    assert sentences(done.stderr) == [f"{why}; the run has no verdict"]
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (record["outcome"], record["outcome_detail"]) == ("not supported", why)
    assert set(verdicts(record).values()) == {"not applicable"}
    assert record["agents"]["2"]["outcome"] == "not supported"
    assert "This run has no verdict" in (tmp_path / "run" / "report.html").read_text()
    assert 'failures="0"' in (tmp_path / "run" / "junit.xml").read_text()
    assert harness("check", tmp_path / "run").returncode == 3


@pytest.mark.any_user
def test_unsupported_command_during_a_run_leaves_no_verdict(tmp_path: Path) -> None:
    command = lacking(tmp_path / "my_agent.py", "stop_events")
    keys = {"vehicles": {"kind": "none"}, "timeline": [{"at_s": 60, "stop_events": [2]}]}
    done = harness("run", write_scenario(tmp_path, agent_command={2: command}, **keys), "--out", tmp_path / "run")
    assert done.returncode == 3
    refused = "refused the command stop_events: mine has no stop_events; the run has no verdict"
    assert sentences(done.stderr) == [f"not supported by agent 2 ({shlex.join(command)}): {refused}"]
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert set(verdicts(record).values()) == {"not applicable"}
    assert 60 <= record["mission_s"] < 200
    assert record["agents"]["1"]["outcome"] == "exported"


@pytest.mark.any_user
def test_shell_that_does_not_find_the_agent_fails_the_run(tmp_path: Path) -> None:
    agent = executable(tmp_path / "my-agent", '#!/bin/sh\nno_such_program "$1"\n')
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, agent_command={2: [str(agent)]})
    done = harness("run", scenario, "--out", tmp_path / "run")
    assert done.returncode == 1
    assert "agent 2 ended by itself with status 127 (" in sentences(done.stderr)[0]
    assert "no_such_program: not found); its log is agents/2.log" in sentences(done.stderr)[0]


def test_end_of_the_lab_is_reported_instead_of_crashed_agents(tmp_path: Path) -> None:
    run = Running(write_scenario(tmp_path, duration_s=100_000, vehicles={"kind": "none"}), tmp_path / "run")
    run.wait_for_mission(1, 2, 3)
    children = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children").read_text().split()
    (unshare,) = (int(child) for child in children if b"netem.init" in Path(f"/proc/{child}/cmdline").read_bytes())
    os.kill(unshare, signal.SIGKILL)
    status, _, err = run.end()
    assert status == 3
    assert sentences(err)[0].startswith("The lab's first process ended unexpectedly")
    assert run.record()["outcome"] == "failed"
    assert not processes(run.out)


@pytest.mark.any_user
def test_agent_that_violates_the_contract_gets_the_reason(tmp_path: Path) -> None:
    program = """
import os, socket, sys
control = sys.argv[1].replace("mission.json", "control")
with socket.socket(socket.AF_UNIX) as server:
    server.bind(control)
    server.listen()
    client, _ = server.accept()
    client.recv(1000)
    client.sendall(b'{"ok": true, "idle": true}\\n')
    client.recv(1000)
"""
    (tmp_path / "my_agent.py").write_text(program)
    command = [sys.executable, str(tmp_path / "my_agent.py")]
    scenario = write_scenario(tmp_path, vehicles={"kind": "none"}, agent_command=command)
    done = harness("run", scenario, "--out", tmp_path / "run")
    assert done.returncode == 1
    assert "does not follow the agent contract: in its status started, reconcile_in_progress" in done.stderr
