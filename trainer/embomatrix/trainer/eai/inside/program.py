"""EAI's published judge as a program in its own interpreter: one JSON order per input line, one JSON result per output line.

The line protocol shows the caller at which answer the program crashed.
"""

import contextlib
import io
import json
import os
import sys
import types
from typing import Any, Final

from embomatrix.trainer.eai.inside.demo import Demo, Package
from embomatrix.trainer.eai.inside.stand_ins import install

FORBIDDEN: Final = (
    "subprocess",
    "socket",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "ctypes",
    "shutil",
)
"""Prefixes of audit events that judging does not need."""


def main() -> None:
    """Orders: ``{"op": "tasks"}``, ``{"op": "judge", "id", "demo", "text"}``, ``{"op": "start", "demo"}``."""
    results, sys.stdout = sys.stdout, sys.stderr
    install()
    from embomatrix.trainer.eai.inside.demo import Package

    judge = PublishedJudge(Package())
    sys.addaudithook(_audit)
    for line in sys.stdin:
        order = json.loads(line)
        with contextlib.redirect_stdout(io.StringIO()):
            result = judge.answer(order)
        results.write(json.dumps(result) + "\n")
        results.flush()


def _audit(event: str, args: tuple[Any, ...]) -> None:
    """Sandbox: the published parser calls eval on a model's text, which must not reach beyond this process."""
    writes = event == "open" and isinstance(args[1], str) and set(args[1]) & set("wax+")
    # The judge silences its own output by writing to the null device.
    if (writes and args[0] != os.devnull) or event.startswith(FORBIDDEN):
        raise PermissionError(f"the judge's sandbox refuses {event}")


class PublishedJudge:
    """Answers orders with the published evaluator over stand-ins for iGibson."""

    def __init__(self, package: Package) -> None:
        import behavior_eval.evaluation.action_sequencing.action_sequence_evaluator as published

        from embomatrix.trainer.eai.inside.demo import Demo

        def environment(demo_name: str, **_: Any) -> Any:
            still = types.SimpleNamespace(close=lambda: None)
            return types.SimpleNamespace(
                task=Demo(package, demo_name),
                env=still,
                apply_action=lambda action, obj: True,
                final_step=lambda: None,
            )

        self._package = package
        self._published = published
        published.EvalEnv = environment

    def answer(self, order: dict[str, Any]) -> dict[str, Any]:
        if order["op"] == "tasks":
            return {"tasks": self._tasks()}
        if order["op"] == "start":
            return self._start(order["demo"])
        return {"id": order["id"], **self._judged(order["demo"], order["text"])}

    def _tasks(self) -> list[dict[str, str]]:
        from embomatrix.trainer.eai.inside.categories import category_of

        return [
            {
                "demo": name,
                "task": stats["task"],
                "scene": stats["scene_id"],
                "prompt": self._package.prompts[name],
                "human": self._package.human_plan(name),
                "category": category_of(self._package, name),
            }
            for name, stats in self._package.stats.items()
        ]

    def _judged(self, name: str, text: str) -> dict[str, Any]:
        from embomatrix.trainer.eai.inside.demo import exact_truths

        evaluator = self._evaluator(name)
        demo: Demo = evaluator.task
        result = evaluator.evaluate_all(text)
        demo.graph = evaluator.evolving_graph.action_env.cur_state
        errors, exact = dict(result["error_type"]), exact_truths(demo)
        # Action without a handler: the published judge stores its exception here.
        errors["unknown_execution"] = result.get("unknown_execution_error")
        return {
            "executed": bool(errors["execution_success"]),
            "official": bool(result["goal_rst"]["all_goal_satisfied_graph"] and errors["execution_success"]),
            "exact": bool(all(exact) and errors["execution_success"]),
            "goals": exact,
            "errors": {
                kind: str(words) for kind, words in errors.items() if words not in (None, True, False)
            },
        }

    def _start(self, name: str) -> dict[str, Any]:
        """Published goals that hold initially, in the reconstruction and in the real simulator."""
        demo: Demo = self._evaluator(name).task
        return {
            "here": demo.check_success()[1]["satisfied"],
            "there": self._package.first_truths[name]["subgoal_success"],
        }

    def _evaluator(self, name: str) -> Any:
        evaluator = self._published.ActionSequenceEvaluator(demo_name=name)
        evaluator.task.graph = evaluator.evolving_graph.action_env.cur_state
        return evaluator


if __name__ == "__main__":
    main()
