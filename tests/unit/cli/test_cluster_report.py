"""Report page of a run."""

import re
from html.parser import HTMLParser

from embomatrix.cli.cluster.charts import throughput_chart
from embomatrix.cli.cluster.report import report_page
from embomatrix.host.durations import seconds_text
from embomatrix.rpc.wire.run_log import (
    EventKind,
    PhaseSummary,
    RolloutPhase,
    RunEvent,
    RunSeries,
    RunSummary,
    RunWorker,
)
from embomatrix.rpc.wire.values import RunInfo, RunStats, Timings

STATS = RunStats(
    delivered=3, infra_failures=1, redispatched=2, prewarm_hits=9, prewarm_misses=1, prewarm_wasted=2
)
TIMINGS = Timings(queued_s=0.1, load_s=0.0, execute_s=0.5, lease_s=0.01)


def summary(**changes):
    found = PhaseSummary(3, 3.0, 0.5, 0.6, 0.7)
    values = {
        "run": RunInfo("r1", "<evening>", STATS, 0, 1_000.0, 1_060.0),
        "phases": dict.fromkeys(RolloutPhase, found),
        "workers": (RunWorker("office & lab", 3, 1, 1.5, 0.2),),
        "series": RunSeries(0.25, (1, 2, 0), (0, 0, 1)),
        "failures": (
            RunEvent(9, 1_010.0, EventKind.FAILED, "r1", "b", "x9", "office", "sha256:0123456789", 1, 2,
                     "slot_crashed", "no <mesh> of 3 \u00b5m"),
        ),
        "manager_cpu_s": 1.0,
        "prewarm_lead": found,
        "scene_load": PhaseSummary(),
        "events_dropped": 0,
        "version": "1.2",
    }  # fmt: skip
    return RunSummary(**{**values, **changes})


EVENTS = tuple(
    RunEvent(
        n, 1_000.0 + n, EventKind.COMPLETED, "r1", "b", f"x{n}", "office", "s", 1, 1,
        timings=TIMINGS, held_s=0.5,
    )
    for n in range(1, 4)
)  # fmt: skip


class Outline(HTMLParser):
    """Resources that a page loads, and a check that its elements are closed in order."""

    VOID = frozenset(("meta", "link", "br"))

    def __init__(self, page):
        super().__init__()
        self.open, self.asked, self.ids, self.scripts = [], [], [], 0
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.asked += [value for name, value in attrs if name in ("src", "href", "xlink:href", "action")]
        self.ids += [values["id"]] if "id" in values else []
        self.scripts += tag == "script"
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_report_page_is_self_contained():
    page = report_page(summary(), EVENTS)
    outline = Outline(page)
    assert outline.open == []
    assert outline.scripts == 0
    assert all(asked.startswith(("#", "data:")) for asked in outline.asked)
    assert not re.search(r"url\((?!#)|@import", page)
    assert len(outline.ids) == len(set(outline.ids)), "an id stands twice"


def test_user_texts_are_escaped():
    page = report_page(summary(), EVENTS)
    assert "&lt;evening&gt;" in page
    assert "no &lt;mesh&gt; of 3 µm" in page
    assert "office &amp; lab" in page
    assert "<evening>" not in page


def test_chart_colours_are_css_variables_of_the_page():
    page = report_page(summary(), EVENTS)
    charts = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert len(charts) == 3
    for chart in charts:
        assert set(re.findall(r"#[0-9a-f]{6}\b", chart)) == set()
        assert "var(--" in chart


def test_report_shows_the_counted_figures():
    words = re.sub(r"<[^>]*>", " ", report_page(summary(), EVENTS))
    words = " ".join(words.split())
    assert "Completed 3 1 failed, 2 re-dispatches" in words
    assert "Prewarm hits 90 % 9 of 10 scenes" in words
    assert "Manager overhead 25 %" in words
    assert "lease failed slot_crashed 2 x9 office 01234567" in words
    assert "All 3 events of the run are kept." in words


def test_failures_of_one_cause_share_a_row_with_the_latest_of_them():
    (first,) = summary().failures
    later = [first._replace(at_s=1_010.0 + n, rollout_id=f"y{n}") for n in range(1, 4)]
    other = first._replace(message="signal 11")
    page = report_page(summary(failures=(first, other, *later)), EVENTS)
    words = " ".join(re.sub(r"<[^>]*>", " ", page).split())
    assert "Latest: 5 failed leases, with the reasons slot_crashed (5)." in words
    assert "00:16:53 lease failed slot_crashed 2 y3 and 3 more office" in words
    assert page.count('<tr class="failure">') == 2


def test_times_of_a_chart_have_simple_ticks():
    svg = throughput_chart(RunSeries(5.0, (1,) * 172, (0,) * 172))  # 14.3 minutes
    assert "min since the run was opened" in svg
    assert re.findall(r">(\d+\.\d{3,})</text>", svg) == []


def test_empty_run_has_a_report():
    nothing = dict.fromkeys(RolloutPhase, PhaseSummary())
    empty = summary(
        run=RunInfo("r1", "", RunStats(), 0, 1_000.0),
        phases=nothing,
        workers=(),
        failures=(),
        series=RunSeries(0.25, (), ()),
    )
    page = report_page(empty, ())
    assert Outline(page).open == []
    assert "No worker has finished anything." in page
    assert "None: every lease brought a result." in page
    assert "Manager overhead – share" in " ".join(re.sub(r"<[^>]*>", " ", page).split())


def test_leases_that_were_given_again_are_told_where_none_failed():
    calm = summary(failures=())
    assert calm.run.stats.redispatched == 2
    page = report_page(calm, EVENTS)
    assert "No lease failed. Rollouts were leased again 2 times, because their workers left" in page
    assert "every lease brought a result" not in page


def test_report_states_dropped_events():
    assert "1,234 earlier ones were dropped" in report_page(summary(events_dropped=1234), EVENTS)


def test_durations_are_formatted_in_fitting_units():
    assert [seconds_text(seconds) for seconds in (0.0, 3e-5, 0.0123, 4.2, 600.0)] == [
        "0",
        "30 µs",
        "12.3 ms",
        "4.2 s",
        "10 min",
    ]
    assert [seconds_text(seconds) for seconds in (90.0, 1234.0, 30_000.0, 61_200.0, 432_000.0, 1e9)] == [
        "90 s",
        "20.6 min",
        "8.33 h",
        "17 h",
        "5 days",
        "11,574 days",
    ]


def test_unit_of_a_duration_fits_its_rounded_number():
    assert [seconds_text(seconds) for seconds in (0.0009999, 0.99996, 119.97, 7199.0, 172_799.0)] == [
        "1 ms",
        "1 s",
        "2 min",
        "2 h",
        "2 days",
    ]
