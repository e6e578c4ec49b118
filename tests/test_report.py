"""The report shows the results' numbers, escapes all text, and needs nothing but a browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from tdgc.benchmark import diagnosis
from tdgc.benchmark.diagnosis import Diagnosis
from tdgc.benchmark.evaluation import CONDITIONS, Episode
from tdgc.benchmark.results import Training, write_results
from tdgc.show import report

EVIL = "<script>alert('x')"  # a policy's name
EVIL_CAUSE = "</td><img src=http://example.org/x onerror=alert(1)>"
REACHED = {"tdgc": 7, EVIL: 0}  # of 10 episodes


def write_picture(path: Path) -> None:
    """Write a picture of noise, 64 x 48."""
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def write_mp4(path: Path) -> None:
    """Write a film of five blank frames, 64 x 48."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(5):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 200, np.uint8), format="rgb24")
            file.mux(stream.encode(frame))
        file.mux(stream.encode())


def write_table(folder: Path, reached_by: dict[str, int] = REACHED) -> None:
    """Write ten nominal episodes per policy on Gap, level 8, and one with pushes."""
    tile = {"family": "gap", "level": 8, "seed": 3}
    walk = {"path_m": 5.25, "energy_j": 500.0, "shares": (1.0, 0.0, 0.0, 0.0)}
    way = {"goal": np.zeros(2), "track": np.zeros((2, 3))}
    episodes = [
        Episode(
            policy, condition, episode=k, outcome="reached" if k < reached else "fell",
            time_s=9.5, **tile, **walk, **way,
        )
        for policy, reached in reached_by.items()
        for condition, count in (("nominal", 10), ("pushes", 1))
        for k in range(count)
    ]  # fmt: skip
    write_results(folder, episodes)
    for name, _, _ in report.FIGURES:
        write_picture(folder / name)


def write_extras(folder: Path) -> None:
    """Write a diagnosis of ``EVIL``'s failures, a tuning's effect, films of episode 0, sheets."""
    failed = [
        Diagnosis(
            EVIL, "nominal", "gap", 8, k, 3, "fell", 9.5, "zone", "trench 2 of 4", layer,
            EVIL_CAUSE, "tilt off by 0.31 rad (limit 0.25)",
        )
        for k, layer in enumerate(["execution"] * 6 + ["decisions"] * 4)
    ]  # fmt: skip
    diagnosis.write(failed, folder / "diagnosis.csv")
    rates = {"n": 10, "reached": 4, "rate": 0.4, "ci_low": 0.168, "ci_high": 0.687}
    before = rates | {"mean_speed": 0.523, "energy_per_metre": 98.7}
    after = rates | {"mean_speed": 0.417, "energy_per_metre": None}
    effect = {"tdgc": before, "tdgc-tuned": after, "gained": 2, "lost": 3}
    result = {
        "tuning": {"decoder": {"vx": {"high": 0.6}}, "decision_rate": 5},
        "effect": {"nominal": effect},
    }
    (folder / "tuning.json").write_text(json.dumps(result), encoding="utf-8")
    films = folder / "films"
    films.mkdir()
    write_mp4(films / "film_tdgc_nominal_gap_08_000.mp4")
    for name in ("film_tdgc_nominal_gap_08_000.gif", f"film_{EVIL}_nominal_gap_08_000.gif",
                 f"sheet_{EVIL}_nominal_gap_08_000.png", "sheet_tdgc_nominal_gap_08_001.png",
                 "strip_gap_8.png"):  # fmt: skip
        write_picture(films / name)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    write_table(folder)
    write_extras(folder)
    return report.write(folder)


class Reader(HTMLParser):
    """What a page shows and what it would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []
        self.data: list[str] = []
        self._in_cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        self._in_cell = tag in ("th", "td") or (self._in_cell and tag in ("b", "small"))
        if tag in ("th", "td"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        self._in_cell = self._in_cell and tag not in ("th", "td")

    def handle_data(self, data: str) -> None:
        self.data.append(data)
        if self._in_cell:
            self.rows[-1][-1] = " ".join([*self.rows[-1][-1].split(), *data.split()])

    @property
    def text(self) -> str:
        return " ".join("".join(self.data).split())

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


# ------------------------------------------------------------------ what it says


def test_rates_have_their_intervals(page: Path) -> None:
    rows = Reader(page.read_text(encoding="utf-8")).rows
    seven, none = "70.0 % 39.7 to 89.2", "0.0 % 0.0 to 27.8"  # Wilson, 7 and 0 of 10
    assert ["nominal", seven, none] in rows
    assert ["pushes", "100.0 % 20.7 to 100.0", "0.0 % 0.0 to 79.3"] in rows  # 1 and 0 of 1
    assert ["family", "level 8", "mean"] in rows
    assert ["gap", seven, seven] in rows and ["gap", none, none] in rows
    assert ["tdgc", "7", "3", "0", "0", "0"] in rows  # outcomes


def test_paired_differences_and_where_dominance_fails(tmp_path: Path) -> None:
    write_table(tmp_path)
    assert "on the same tiles" not in Reader(report.render(tmp_path)).text
    write_table(tmp_path, {"tdgc": 0, "gp": 10})
    reader = Reader(report.render(tmp_path))
    assert ["condition", "gap", "mean"] in reader.rows
    # All ten tiles are lost: Wilson's 0 to 0.278 and 0.722 to 1, added in quadrature.
    lost = "-100.0 below gp -100.0 to -60.8"
    assert ["nominal", lost, lost] in reader.rows
    assert ["pushes", *["-100.0 -100.0 to +12.2"] * 2] in reader.rows  # one tile proves nothing


def test_mirrored_tiles_and_other_editions(tmp_path: Path) -> None:
    """Of ten tiles seven are reached, of their images two, and one of Tilt both ways."""
    way = {"goal": np.zeros(2), "track": np.zeros((2, 3))}
    walk = {"time_s": 9.5, "path_m": 5.25, "energy_j": 500.0, "shares": (1.0, 0.0, 0.0, 0.0)}
    episodes = [
        Episode(
            EVIL, condition, family, 8, k, 3, "reached" if k < reached else "fell", **walk, **way
        )
        for condition, family, reached, count in (
            ("nominal", "gap", 7, 10), ("nominal", "tilt", 1, 1),
            ("mirrored", "gap", 2, 10), ("mirrored", "tilt", 1, 1),
        )
        for k in range(count)
    ]  # fmt: skip
    training = Training({"low": 1, "high": 2}, ["robot.kp=18.6, not 20.0", "robot.kd=0.5, not 0.6"])
    summary = write_results(tmp_path, episodes, training)
    for name, _, _ in report.FIGURES:
        write_picture(tmp_path / name)
    reader = Reader(report.render(tmp_path))
    assert ["policy", "gap", "tilt", "mean"] in reader.rows
    (found,) = [row for row in reader.rows if row[0] == EVIL and "+" in row[2]]
    low, high = (100 * summary["sides"][EVIL]["gap"][key] for key in ("ci_low", "ci_high"))
    assert found[1] == f"-50.0 {low:+.1f} to {high:+.1f}" and high < 0.0  # but not "below" anything
    assert found[2].startswith("+0.0 ") and found[3].startswith("-45.5 ")
    assert "mirrored tiles - the tiles themselves, in points of success" in reader.text
    assert (
        "The low policy was trained on edition 1 of TDGC-Bench, these tiles are of edition 2."
        in reader.text
    )
    text = "Not the benchmark's robot: robot.kp=18.6, not 20.0; robot.kd=0.5, not 0.6."
    assert text in reader.text
    assert "The high policy" not in reader.text and "episodes: 22; edition 2; tdgc" in reader.text
    write_results(tmp_path, episodes[:10])
    text = Reader(report.render(tmp_path)).text
    assert "mirrored" not in text and "edition" not in text and "benchmark's robot" not in text


def test_only_height_maps_may_have_been_trained_on(tmp_path: Path) -> None:
    write_table(tmp_path)
    text = Reader(report.render(tmp_path)).text
    assert text.endswith("starts and goals, none of which was used in training.")
    table = tmp_path / "episodes.csv"
    changed = table.read_text(encoding="utf-8").replace(",gap,", ",hills.npy,")
    table.write_text(changed, encoding="utf-8")
    assert Reader(report.render(tmp_path)).text.endswith(
        "none of which was used in training, except height maps that a policy was trained on."
    )


def test_diagnosis_tuning_and_conditions(page: Path) -> None:
    reader = Reader(page.read_text(encoding="utf-8"))
    assert ["gap", "8", "4", "6", "0", f"{EVIL_CAUSE} (10)"] in reader.rows
    assert "10 of 10 episodes failed. Most is to be won in gap, by execution: 60.0 points" in (
        reader.text
    )
    assert ["tdgc", "40.0 % 16.8 to 68.7", "0.52 m/s", "99 J/m"] in reader.rows
    assert ["tdgc-tuned", "40.0 % 16.8 to 68.7", "0.42 m/s", "did not move"] in reader.rows
    assert "decoder.vx.high=0.6 decision_rate=5" in reader.text
    assert "Of 10 tiles 2 were gained and 3 lost." in reader.text
    assert ["pushes", "pushes of 0.75 m/s every 3 s", "gap", "8", "1"] in reader.rows


def test_films_of_one_tile_under_both_policies(page: Path) -> None:
    reader = Reader(page.read_text(encoding="utf-8"))
    assert "Episodes filmed: 3;" in reader.text  # of which two are of the first tile
    (video,) = reader.named("video")
    assert str(video["src"]).startswith("data:video/mp4;base64,")
    kinds = [str(image["src"]).partition(";")[0] for image in reader.named("img")]
    assert kinds == ["data:image/png"] * 5 + ["data:image/gif", "data:image/png"]
    assert f"{EVIL}: fell after 9.5 s, 5.25 m walked. Blamed on execution" in reader.text
    assert "tilt off by 0.31 rad (limit 0.25)" in reader.text


def test_films_beyond_the_room_are_named(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = page.parent / "films" / "film_tdgc_nominal_gap_08_000.mp4"
    monkeypatch.setattr(report, "FILM_BYTES", first.stat().st_size)
    reader = Reader(report.render(page.parent))
    assert len(reader.named("video")) == 1
    assert f"Too large for this page: films/film_{EVIL}_nominal_gap_08_000.gif" in reader.text


def test_films_are_named_as_recordings_are() -> None:
    row = {
        "policy": "gp", "condition": "pushes", "family": "my/hills.npy", "level": "8",
        "episode": "12", "seed": "0", "outcome": "fell",
    }  # fmt: skip
    assert report.record_of(row).name == "gp_pushes_my-hills.npy_08_012"


def test_every_condition_but_nominal_changes_something_of_its_own() -> None:
    texts = {name: c.what for name, c in CONDITIONS.items()}
    assert [name for name, text in texts.items() if text == "nothing"] == ["nominal"]
    assert len(set(texts.values())) == len(CONDITIONS)
    assert texts["latency-30ms"] == "commands reach the joints 30 ms late"


# ------------------------------------------------------------------ what it needs


def test_all_is_escaped_and_inside(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    reader = Reader(text)
    assert not reader.named("script") and not reader.named("link") and not reader.named("iframe")
    # The cause names an address; nothing loads it, and it is the only one.
    assert not re.search(r"https?://", text.replace("http://example.org/x", ""))
    for _, attributes in reader.tags:
        assert str(attributes.get("src", "data:")).startswith("data:")
        assert str(attributes.get("href", "#")).startswith("#")
        assert not [name for name in attributes if name.startswith("on")]
    assert not re.search(r"url\(|@import", text)


def test_accessible(page: Path) -> None:
    reader = Reader(page.read_text(encoding="utf-8"))
    assert all(image["alt"] for image in reader.named("img"))
    assert all(cell["scope"] in ("row", "col") for cell in reader.named("th"))
    assert all(video["aria-label"] for video in reader.named("video"))
    assert reader.named("html") == [{"lang": "en"}]
    targets = {attributes.get("id") for _, attributes in reader.tags}
    links = [str(link["href"])[1:] for link in reader.named("a")]
    assert len(links) == 6 and set(links) <= targets


def test_a_bare_table_has_no_empty_sections(tmp_path: Path) -> None:
    write_table(tmp_path)
    reader = Reader(report.write(tmp_path).read_text(encoding="utf-8"))
    assert [s["id"] for s in reader.named("section")] == ["success", "figures", "conditions"]


def test_no_page_of_half_the_results(tmp_path: Path) -> None:
    write_table(tmp_path)
    (tmp_path / "gaits.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"gaits\.png"):
        report.write(tmp_path)
    assert not list(tmp_path.glob("report*"))
    write_table(tmp_path)
    (tmp_path / report.NAME).mkdir()  # so that the page cannot replace it
    with pytest.raises(OSError):
        report.write(tmp_path)
    assert [p.name for p in tmp_path.glob("report*")] == [report.NAME]


def test_an_unknown_condition_is_refused(tmp_path: Path) -> None:
    write_table(tmp_path)
    table = tmp_path / "episodes.csv"
    table.write_text(table.read_text(encoding="utf-8").replace("pushes", "kicks"), encoding="utf-8")
    with pytest.raises(ValueError, match=r"condition 'kicks'; allowed: nominal, .*pushes"):
        report.render(tmp_path)


# ------------------------------------------------------------------ in a browser


def browse(page: Path, *flags: str) -> tuple[str, list[str]]:
    """Open a page in a headless browser; return its output and the lines of its console."""
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.fail(f"no browser ({', '.join(names)}): on Debian, apt-get install chromium")
    always = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    always += [f"--user-data-dir={page.parent / 'profile'}", "--virtual-time-budget=10000"]
    result = subprocess.run(
        [found, *always, *flags, page.as_uri()],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert result.returncode == 0, result.stderr[-4000:]
    return result.stdout, [line for line in result.stderr.splitlines() if ":CONSOLE" in line]


def test_a_browser_shows_it_without_complaint(page: Path) -> None:
    dom, console = browse(page, "--dump-dom")
    reader = Reader(dom)
    assert console == []  # where a blocked or broken resource would be reported
    assert not reader.named("script")
    assert f"<title>TDGC-Bench: tdgc, {EVIL.replace('<', '&lt;').replace('>', '&gt;')}" in dom
    assert len(reader.named("img")) == 7 and len(reader.named("video")) == 1


#: Script that reports on the console how the browser loaded the page.
PROBE = """<script>
addEventListener("load", () => {
  const video = document.querySelector("video"), root = document.documentElement;
  const report = () => console.log("probe " + JSON.stringify({
    widths: [...document.images].map(image => image.naturalWidth),
    video: [video.videoWidth, video.error],
    overflow: root.scrollWidth - root.clientWidth,
    outside: performance.getEntriesByType("resource").filter(r => !r.name.startsWith("data:")),
  }));
  if (video.readyState > 0) report(); else video.addEventListener("loadedmetadata", report);
});
</script>"""


def test_pictures_and_film_load_and_a_phone_has_room(page: Path, tmp_path: Path) -> None:
    text = page.read_text(encoding="utf-8").replace("<details>", "<details open>")
    text = text.replace("style-src", "script-src 'unsafe-inline'; style-src", 1)
    copy, shot = tmp_path / "probed.html", tmp_path / "shot.png"
    copy.write_text(text.replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    _, console = browse(copy, "--window-size=500,900", f"--screenshot={shot}")
    (line,) = console
    found = json.loads(line.split("probe ", 1)[1].rpartition("}")[0] + "}")
    assert found == {"widths": [64] * 7, "video": [64, None], "overflow": 0, "outside": []}
    with Image.open(shot) as image:
        assert image.size == (500, 900) and len(image.convert("RGB").getcolors(10**6) or []) > 50
