"""The command line: exit codes, one sentence for whatever is wrong, and nothing written then."""

import contextlib
import inspect
import io
import re
import runpy
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest
from rich.console import Console

import bstcad
from bstcad import cli
from bstcad.designs import folder as folders
from bstcad.report import manual
from bstcad.runs import progress, signals
from bstcad.tailoring.driver import Hooks

ROOT = Path(__file__).parent.parent
THU = str(ROOT / "templates" / "thu.toml")


class FakeCommands(types.ModuleType):
    """Stands for bstcad.commands: keeps its arguments and answers with a report."""

    def __init__(self):
        super().__init__("bstcad.commands")
        self.folders, self.Hooks = folders, Hooks
        self.calls = []
        self.passed = True
        self.error = None

    def generate(self, scene, folder, hooks, device, began, resume):
        self.calls.append((scene, folder, device))
        hooks.progress("stage 1", 1, 2, "RRMSD 0.5")
        hooks.progress("stage 1", 2, 2, "RRMSD 0.25")
        return self._report()

    def verify(self, path, progress, against, **asked):
        self.calls.append((path, *against))
        return self._report()

    def _report(self):
        if self.error:
            raise self.error
        contents = types.SimpleNamespace(passed=self.passed)
        return types.SimpleNamespace(stopped="evaluations", contents=contents, notes=())


@pytest.fixture
def commands(monkeypatch, tmp_path):
    """A fake engine and report, in an empty working folder."""
    fake = FakeCommands()
    report = types.ModuleType("bstcad.report.report")
    report.summary = lambda report, verbose: f"verdict {report.passed}{', every check' if verbose else ''}"
    monkeypatch.setitem(sys.modules, "bstcad.commands", fake)
    monkeypatch.setattr(bstcad, "commands", fake, raising=False)
    monkeypatch.setitem(sys.modules, "bstcad.report.report", report)
    monkeypatch.setattr("bstcad.planning.net_choice.with_net", lambda scene, say: (scene, None))
    monkeypatch.chdir(tmp_path)
    return fake


@pytest.mark.parametrize("command", [["generate", THU], ["verify", "."]], ids=lambda command: command[0])
def test_the_exit_code_is_the_verdict_and_every_check_is_listed_when_asked(commands, capsys, command):
    for passed, option in ((True, []), (False, ["--verbose"])):
        commands.passed = passed
        assert cli.run([*command, *option]) == (0 if passed else 1)
        out, err = capsys.readouterr()
        assert f"verdict {passed}" in out and ("every check" in out) is bool(option)
        assert ("stage 1: 2/2, RRMSD 0.25" in err) is (command[0] == "generate")


@pytest.mark.parametrize(("points", "size"), [(65, None), (2049, r"about \d+ MB for 2049 x 2049 control points")])
def test_a_large_file_is_said_before_the_design(commands, capsys, points, size):
    assert cli.run(["generate", THU, "--set", f"lens.back.control_points={points}"]) == 0
    before, stage, _ = capsys.readouterr().err.partition("stage 1")
    assert stage and (re.search(f"lens.step will have {size}", before) if size else "lens.step" not in before)


def test_options_reach_the_commands(commands, tmp_path):
    arguments = ["--set", "target.pixels=64", "--set", "title=A = B", "--quality", "draft", "--device", "cpu"]
    assert cli.run(["generate", THU, "-o", str(tmp_path / "mine"), *arguments]) == cli.run(["generate", THU]) == 0
    (scene, *given), (other, *default) = commands.calls
    assert (scene.target.pixels, scene.title, scene.tailoring.quality) == (64, "A = B", "draft")
    assert given == [tmp_path / "mine", "cpu"] and default == [Path("outputs/thu"), "auto"] and other.name == "thu"
    assert cli.run(["verify", str(tmp_path), "--against", "batoid, mitsuba"]) == cli.run(["verify", str(tmp_path)]) == 0
    assert commands.calls[2:] == [(tmp_path, "batoid", "mitsuba"), (tmp_path,)]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["generate"], "missing argument 'SCENE'"),
        (["generate", "none.toml"], "none.toml: no such scene file"),
        (["generate", THU, "--foo"], "no such option: --foo"),
        (["verfy", "x"], "no such command 'verfy'; did you mean 'verify'?"),
        (["check", "x"], "did you mean 'verify'?"),
        (["my.toml"], "no such command 'my.toml'; did you mean 'generate my.toml'?"),
        (["lens.step"], "did you mean 'verify lens.step'?"),
        (["foo"], "no such command 'foo'; see bstcad --help"),
        (["generate", THU, "--set", "pixels"], "--set pixels: has no value"),
        (["generate", THU, "--set", "target.pixel=3"], "did you mean 'pixels'?"),
        (["generate", THU, "-o", THU], "is a file; give another folder"),
        (["generate", THU, "-o", THU + "/x"], "cannot be created"),
        (["generate", THU, "-o", str(ROOT)], "contains files that are not a design's"),
        (["verify", "none"], "none: no such folder"),
        (["verify"], "missing argument"),
        (["generate", "a\udcff.toml"], "its name is not UTF-8 text"),
        (["verify", "a\udcff"], "its name is not UTF-8 text; rename it"),
        (["tradeoff", THU, "--budget", "0"], "--budget 0: is not between"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_input_ends_with_2_and_one_sentence(commands, capsys, tmp_path, arguments, sentence):
    before = Path(THU).read_bytes()
    assert cli.run(arguments) == 2
    out, err = capsys.readouterr()
    assert sentence in err
    assert err.startswith("bstcad: ") and err.count("\n") == 1 and out == ""
    assert commands.calls == [] and list(tmp_path.iterdir()) == [] and Path(THU).read_bytes() == before


def test_an_older_design_survives_wrong_input(commands, tmp_path):
    older = tmp_path / "outputs" / "thu"
    older.mkdir(parents=True)
    (older / "lens.step").write_text("old")
    assert cli.run(["generate", THU, "--set", "lens.back.z=3"]) == 2
    assert (older / "lens.step").read_text() == "old"
    assert cli.run(["generate", THU]) == 0  # an earlier design may be replaced


TOO_LITTLE = "this machine has too little memory for this design"
FAULTS = (  # (error of a command, exit code, words of the last line)
    (KeyboardInterrupt(), 130, "bstcad: stopped; there was no lens yet, and nothing is kept"),
    (OSError(28, "No space left on device", "outputs/thu"), 2, "outputs/thu: No space left"),
    (MemoryError(), 2, TOO_LITTLE),
    (RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 8 bytes."), 2, TOO_LITTLE),
    (RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"), 2, TOO_LITTLE),
    (OSError(12, "Cannot allocate memory"), 2, TOO_LITTLE),
    (ImportError("libx.so: failed to map segment from shared object"), 2, TOO_LITTLE),
    (RuntimeError("expected scalar type Double but found Float"), 70, "please report it"),
    (ZeroDivisionError("oops"), 70, "please report it"),  # neither 1, a failed check, nor 2, wrong input
)


@pytest.mark.parametrize(("fault", "code", "words"), FAULTS, ids=lambda value: str(value)[:40])
def test_a_fault_is_one_sentence_and_a_traceback_if_it_is_ours(commands, capsys, fault, code, words):
    commands.error = fault
    if code == 2:
        fault.add_note("the design so far is kept")
    assert cli.run(["generate", THU]) == code
    err = capsys.readouterr().err
    last = err.splitlines()[-1]
    assert last.startswith("bstcad: ") and words in last and ("so far is kept" in last) is (code == 2)
    assert ("Traceback" in err) is (code == 70)


def test_an_interrupted_plan_does_not_speak_of_a_lens(capsys, monkeypatch):
    def interrupt(*given):
        signal.default_int_handler(signal.SIGINT, None)  # a background job may ignore the signal itself

    monkeypatch.setattr(cli, "load_scene", interrupt)
    monkeypatch.setattr(signals, "exit_on_signal", contextlib.nullcontext)
    assert cli.run(["plan", THU]) == 130
    assert capsys.readouterr().err == "bstcad: stopped; nothing more is written\n"


def test_paths_that_lead_nowhere_are_one_sentence(commands, capsys, monkeypatch, tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for folder in ("a", "a/x"):
        assert cli.run(["generate", THU, "-o", folder]) == 2
        assert f"{folder}: is a link that leads back to itself; give another folder" in capsys.readouterr().err
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    for arguments in (["generate", THU], ["generate", "x.toml"], ["verify", "x"], ["verify", str(tmp_path)]):
        assert cli.run(arguments) == 2
        said = capsys.readouterr().err
        assert said == "bstcad: the working folder was deleted; change to another folder (cd) and try again\n"
    monkeypatch.chdir(tmp_path)
    assert commands.calls == []


def test_a_tilde_is_the_users_home(commands, monkeypatch, tmp_path):
    """`-o=~/x` and the like reach us as they are written."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "my.toml").write_text(Path(THU).read_text())
    assert cli.run(["generate", "~/my.toml", "-o", "~/lens"]) == 0
    (tmp_path / "made").mkdir()
    assert cli.run(["verify", "~/made"]) == 0
    assert [commands.calls[0][1], *commands.calls[1]] == [tmp_path / "lens", tmp_path / "made"]


def test_a_warning_does_not_stop(commands, capsys):
    assert cli.run(["generate", THU, "--set", 'source.aperture={shape="circle",radius=13}']) == 0
    assert "bstcad: warning: source.aperture" in capsys.readouterr().err


def test_version_and_help(capsys):
    """Square brackets are rich's markup; of no help text may a word be lost to it."""
    assert cli.run(["--version"]) == 0
    assert capsys.readouterr().out == f"bstcad {bstcad.__version__}\n"
    for arguments in ([], ["--help"]):
        assert cli.run(arguments) == 0
        out = capsys.readouterr().out
        assert "generate" in out and "verify" in out
    for command in cli.app.registered_commands:
        name = command.name or command.callback.__name__
        assert cli.run([name, "--help"]) == 0
        out = capsys.readouterr().out
        *_, first, second = (line.strip() for line in out.splitlines() if line.strip())
        assert first.startswith(f"bstcad {name}") and second.startswith(f"bstcad {name}")  # two examples
        shown = "".join(letter for letter in out if letter not in "│ \n")
        for option in inspect.signature(command.callback, eval_str=True).parameters.values():
            said = option.annotation.__metadata__[0].help
            assert said.replace("\\[", "[").replace(" ", "") in shown


def test_generate_lens_takes_what_generate_takes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["generate_lens.py", "none.toml", "--quality", "draft"])
    monkeypatch.setattr(cli, "main", lambda words: sys.exit(cli.run(words)))  # `main` ends processes of other tests
    with pytest.raises(SystemExit, match="^2$"):
        runpy.run_path(str(ROOT / "generate_lens.py"), run_name="__main__")
    assert capsys.readouterr().err.startswith("bstcad: none.toml: no such scene file")


def test_progress_is_few_lines_that_show_the_end_or_bars_with_the_merit():
    now = iter(range(1000))  # one second a call
    console = Console(file=io.StringIO(), width=40)
    with progress.lines(console, clock=lambda: float(next(now))) as report:
        for done in range(101):
            report("stage 2", done, 100, f"RRMSD {1 / (1 + done):.3f}")
    printed = console.file.getvalue().splitlines()
    assert len(printed) == 35  # every third of 101, and the last
    assert printed[1] == "stage 2: 3/100, RRMSD 0.250, 97 s left"
    assert printed[-1] == "stage 2: 100/100, RRMSD 0.010, 100.0 s"
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    with progress.watch(console) as report:
        report("transport", 5, 10, "cost 3.1")
        report("stage 1", 1, 10, "RRMSD 0.123")
    assert "RRMSD 0.123" in console.file.getvalue() and "transport" in console.file.getvalue()


@pytest.mark.parametrize("library", [
    "typer", "torch._C", *(pytest.param(library, marks=pytest.mark.bench) for library in (
        "loky.process_executor", "numpy.linalg", "scipy.sparse", "llvmlite", "pydantic", "bstcad.commands",
    )),
])  # fmt: skip
def test_ctrl_c_ends_at_once_while_libraries_load_and_is_heard_by_one_process_only(library, tmp_path):
    """A terminal sends the signal to both processes while this one loads a library: some libraries swallow it."""
    code = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # the suite may be deaf
        "class Press:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {library!r}:\n"
        "            sys.meta_path.remove(self)\n"
        "            os.killpg(0, signal.SIGINT)\n"
        "sys.meta_path.insert(0, Press())\n"
        "from bstcad.cli import main; main()"
    )
    command = [sys.executable, "-c", code, "generate", THU, "-o", str(tmp_path / "thu")]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, start_new_session=True, check=False)
    said = run.stdout + run.stderr
    assert run.returncode == cli.INTERRUPTED and "Traceback" not in said
    assert said.splitlines()[-1] == "bstcad: stopped at its start; nothing was written"
    assert list(tmp_path.iterdir()) == []


def test_a_sweep_has_its_folder_budget_and_settings(monkeypatch, tmp_path, capsys):
    """Without a lens it ends with 1; interrupted, it says how to go on."""
    from bstcad.planning import results
    from bstcad.planning import tradeoff as sweeping

    calls, lenses, stops = [], ["a run"], []

    def tradeoff(scene, folder, **options):
        calls.append((scene, folder, options["budget"]))
        if stops:
            raise stops[0]
        return types.SimpleNamespace(runs_with_lens=lenses)

    monkeypatch.setattr(sweeping, "tradeoff", tradeoff)
    monkeypatch.setattr(results, "summary", lambda found: "what it costs")
    monkeypatch.chdir(tmp_path)
    assert cli.run(["tradeoff", THU, "--budget", "90", "--set", "target.pixels=64", "--quality", "draft"]) == 0
    [(scene, *given)] = calls
    assert given == [Path("outputs/thu-tradeoff"), 90.0] and "what it costs" in capsys.readouterr().out
    assert (scene.target.pixels, scene.tailoring.quality) == (64, "draft")
    lenses.clear()
    assert cli.run(["tradeoff", THU, "-o", "mine"]) == 1
    stops.append(KeyboardInterrupt())
    stops[0].add_note("3 runs are stored in mine; the same command continues from there")
    assert cli.run(["tradeoff", THU]) == 130
    assert "stopped; 3 runs are stored in mine" in capsys.readouterr().err


def test_docs_explains_a_check_and_names_its_page(capsys, monkeypatch, tmp_path):
    (tmp_path / "index.html").write_text("built")
    monkeypatch.setattr(manual, "SITES", (tmp_path / "none", tmp_path))
    assert cli.run(["docs", "check-rrmsd"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("### ") and "accept.rrmsd" in out
    assert out.endswith(f"Documentation: {tmp_path / 'reference/checks.html#check-rrmsd'}\n")
    assert cli.run(["docs"]) == 0
    assert capsys.readouterr().out == f"Documentation: {tmp_path / 'index.html'}\n"
    assert cli.run(["docs", "first-lens"]) == 0
    assert capsys.readouterr().out == f"Documentation: {tmp_path / 'tutorials/first-lens.html'}\n"
    assert cli.run(["docs", "check-rmsd"]) == 2
    assert capsys.readouterr().err.strip().endswith("did you mean 'check-rrmsd'?")


def test_docs_of_a_wheel_knows_its_built_pages(capsys, monkeypatch, tmp_path):
    """An installed wheel has no Markdown but checks and remarks: the command's own example was refused there."""
    (tmp_path / "tutorials").mkdir()
    for name in ("index", "tutorials/first-lens"):
        (tmp_path / f"{name}.html").write_text("built")
    monkeypatch.setattr(manual, "SITES", (tmp_path,))
    monkeypatch.setattr(manual, "PLACES", (tmp_path / "none",))
    manual.pages.cache_clear()
    try:
        for name in ("first-lens", "tutorials/first-lens"):
            assert cli.run(["docs", name]) == 0
            assert capsys.readouterr().out == f"Documentation: {tmp_path / 'tutorials/first-lens.html'}\n"
        assert cli.run(["docs", "first-lense"]) == 2
    finally:
        manual.pages.cache_clear()


def test_docs_without_built_pages_shows_their_text(capsys, monkeypatch, tmp_path):
    """The text comes from the sources; a copy without them has the pages of checks and remarks."""
    monkeypatch.setattr(manual, "SITES", (tmp_path,))
    assert cli.run(["docs"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("# bstcad\n") and "make docs builds them" in err
    assert "- `bstcad docs how-to/resume`: " in out and "- **Tutorials** (`bstcad docs tutorials/index`)" in out
    for name in ("resume", "how-to/resume", "how-to/resume.md"):
        assert cli.run(["docs", name]) == 0
        out = capsys.readouterr().out
        assert out.startswith("# ") and "(`bstcad docs reference/remarks`)" in out and "](" not in out
    monkeypatch.setattr(manual, "PLACES", (tmp_path,))
    manual.pages.cache_clear()
    try:
        assert cli.run(["docs"]) == 0 and "- `bstcad docs reference/checks`: " in capsys.readouterr().out
        assert cli.run(["docs", "checks"]) == 0 and "accept.rrmsd" in capsys.readouterr().out
        assert cli.run(["docs", "resume"]) == 2
    finally:
        manual.pages.cache_clear()


def test_every_page_of_the_documentation_can_be_read_in_a_terminal():
    for name in manual.pages():
        text = manual.page(name)
        assert text.startswith("# ") and not re.search(r"^(:::|```\{|\([\w-]+\)=$)", text, re.M), name
