"""Table of every decoder: code that turns bytes or text of another machine or person into values.

``OWN`` lists the functions with a parsing call that read no such bytes. The table and ``OWN`` together name every function
with a parsing call in the source code, so a new one can't be forgotten.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Mapping
from typing import Final

from tests.fuzz.decoder import Decoder

from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.rpc.wire.outcome import _step_of
from embomatrix.rpc.wire.rollout import _call_of

SECTIONS: Final = ("world", "wire", "cluster", "models", "training", "sequences")
"""Modules with decoders."""


@functools.cache
def section(name: str) -> dict[str, Decoder]:
    """Return the decoders of one module."""
    found: dict[str, Decoder] = importlib.import_module(f"tests.fuzz.{name}").table()
    return found


def decoders() -> dict[str, Decoder]:
    """Return all decoders by name."""
    return {name: decoder for part in SECTIONS for name, decoder in section(part).items()}


def forget_inputs() -> None:
    """Clear the caches of readers that skip inputs which they have read before."""
    for reader in (_step_of, _call_of, read_problem):
        reader.cache_clear()


PACKAGED: Final = "a file of this package"
CHILD: Final = "a process that this program started on the same machine"
WRITTEN: Final = "a value that this process made, or a file that this program has just written"
LIBRARY: Final = "a model file that its library reads; test_hf_policy, test_lora, test_memory and test_model read damaged ones"
BENCH: Final = "a benchmark's own files, and messages that its attackers receive"
DEVELOPER: Final = "a tool that rebuilds the catalog from packages that a developer installed"

OWN: Final[Mapping[str, str]] = {
    "bench.adversary.attackers:_collect_leases": BENCH,
    "bench.adversary.attackers:_register": BENCH,
    "bench.adversary.attackers:fast_liar": BENCH,
    "bench.adversary.sequences:_Foe.listen": BENCH,
    "bench.adversary.sequences:_HonestStub.Session": BENCH,
    "bench.adversary.sequences:_Stage._register": BENCH,
    "bench.adversary.sequences:_honest_run": BENCH,
    "bench.adversary.sequences:_honest_worker": BENCH,
    "bench.adversary.siege:read_state": BENCH,
    "bench.adversary.trainer_kinds:_padded_call": BENCH,
    "bench.traffic.recording:sampled_traffic": BENCH,
    "bench.traffic.recording:save_sample": BENCH,
    "bench.adversary.worker_kinds:_padded_step": BENCH,
    "bench.experiments.benchmarks:bench_table": BENCH,
    "bench.experiments.cli:_conduct": BENCH,
    "bench.experiments.design:_is_toml": BENCH,
    "bench.experiments.design:keep_design": BENCH,
    "bench.first_hour.record:read_record": BENCH,
    "bench.first_hour.seeds:_finished": BENCH,
    "bench.fidelity.suite:_lines": BENCH,
    "bench.fidelity.suite:_trials": BENCH,
    "bench.peers.scene_process:SceneProcess.execute": BENCH,
    "bench.report.figures:read_result": BENCH,
    "bench.trainer.steps:parse_step_s": BENCH,
    "bench.trainer.trl_steps:": BENCH,
    "sim.fidelity.compare:comparison_from_json": BENCH,
    "factory.catalog_tables:_masses": DEVELOPER,
    "factory.catalog_tables:_read_json": DEVELOPER,
    "factory.catalog_tables:build_substances": DEVELOPER,
    "factory.evaluate.aesthetics:Calibration.load": PACKAGED,
    "factory.evaluate.lies:LieTable.load": PACKAGED,
    "factory.evaluate.lies:_scripted": PACKAGED,
    "factory.evaluate.scenes:fixed_tasks": PACKAGED,
    "factory.clutter.shares:all_shares": PACKAGED,
    "factory.clutter.tables:main": DEVELOPER,
    "factory.language.clauses:_phrases": PACKAGED,
    "factory.language.kinds:kinds": PACKAGED,
    "factory.social.knowledge:_table": PACKAGED,
    "sim.bullet.robot_model:robot_urdf": PACKAGED,
    "trainer.eai.environment:JudgeEnvironment.package_root": PACKAGED,
    "trainer.eai.environment:_unpack": PACKAGED,
    "trainer.eai.inside.demo:Package.__init__": PACKAGED,
    "trainer.eai.inside.demo:Package.read": PACKAGED,
    "trainer.eai.inside.demo:simulator_names": PACKAGED,
    "cli.demo:_ensure_tasks": PACKAGED,
    "factory.commands.evaluate:_shipped": PACKAGED,
    "factory.commands.starter:starter": PACKAGED,
    "world.catalog:_read": PACKAGED,
    "starter.archive:packed_records": PACKAGED,
    "starter.shipped:holds_shipped": PACKAGED,
    "starter.shipped:unpacked_tasks": PACKAGED,
    "world.substances:_table": PACKAGED,
    "sim.zygote:frame_lengths": CHILD,
    "sim.zygote:receive": CHILD,
    "sim.zygote:unpack": CHILD,
    "trainer.eai.inside.program:main": CHILD,
    "trainer.eai.judge:NativeJudge._request": CHILD,
    "trainer.learning.data_parallel:RemoteLearner._request": CHILD,
    "trainer.learning.data_parallel:SharedTensors.__init__": CHILD,
    "trainer.learning.data_parallel:_serve": CHILD,
    "worker.slots.processes:ProcessChannel.arrived": CHILD,
    "worker.slots.processes:ProcessChannel.receive": CHILD,
    "worker.slots.slot_program:ProgressBoard.steps": CHILD,
    "worker.slots.slot_program:_answer": CHILD,
    "cli.doctor.app:_joined_authority": WRITTEN,
    "cli.doctor.worker:worker": WRITTEN,
    "factory.commands.inspection:_tree_in": WRITTEN,
    "manager.access.certificates:make_server_certificate": WRITTEN,
    "manager.services.rollout:RolloutServicer._results": WRITTEN,
    "manager.web.rewards:_read": WRITTEN,
    "sim.fidelity.plans:_Writer.__init__": WRITTEN,
    "trainer.logging.evaluations:_rows": WRITTEN,
    "trainer.logging.recorder:read_metrics": WRITTEN,
    "worker.host.settings:WorkerSettings": WRITTEN,
    "world.tables:TableWriter.arrays": WRITTEN,
    "world.json_text:parse_json": "the parser that others call",
    "trainer.policy.hf:HfPolicy.load": LIBRARY,
    "trainer.policy.import_gguf:_unpack": LIBRARY,
    "trainer.policy.import_gguf:import_gguf": LIBRARY,
    "trainer.policy.lora:load_adapters": LIBRARY,
    "trainer.policy.model_shape:language_model_shape": LIBRARY,
}
"""Functions with a parsing call that read no foreign bytes, and what they read."""
