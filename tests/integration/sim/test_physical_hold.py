"""Grasps of flat objects, and regrasps before an object is placed."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes import furniture as make
from tests.fakes.plans import executed, with_objects
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.physical.grasp import SHEET_M, grasp_tool_paths, surface_point
from embomatrix.world.bundle import Bundle
from embomatrix.world.geometry import Pose

TABLE_TOP_M = 0.75

angles = st.floats(-3.1, 3.1)


@pytest.fixture
def play():
    simulators = []

    def executed_with(extra, text):
        simulator = physical_simulator(Bundle(with_objects(kitchen_scene(), extra), {}))
        simulators.append(simulator)
        return executed(simulator, text), simulator

    yield executed_with
    for simulator in simulators:
        simulator.close()


@given(angles, angles, angles)
def test_pose_is_recovered_from_its_rotation_matrix(roll, pitch, yaw):
    half = Pose.from_xyz_yaw(0.0, 0.0, 0.0, yaw)
    tilt = Pose((0.0, 0.0, 0.0), (np.sin(roll / 2), 0.0, 0.0, np.cos(roll / 2)))
    nod = Pose((0.0, 0.0, 0.0), (0.0, np.sin(pitch / 2), 0.0, np.cos(pitch / 2)))
    pose = half @ tilt @ nod
    again = Pose.from_rotation((1.0, 2.0, 3.0), pose.rotation)
    assert again.position_m == (1.0, 2.0, 3.0)
    assert again.rotation == pytest.approx(pose.rotation, abs=1e-9)


def test_ray_returns_entry_point_and_thickness():
    boxes = [(Pose((0.0, 0.0, 1.0)), (0.2, 0.2, 0.04)), (Pose((0.0, 0.0, 0.5)), (0.2, 0.2, 0.1))]
    point, thick_m, number = surface_point(boxes, np.zeros(3), np.array([0.0, 0.0, -1.0]))
    assert point == pytest.approx([0.0, 0.0, 1.02])
    assert thick_m == pytest.approx(0.04)
    assert number == 0
    assert surface_point(boxes, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])) is None


def test_grasp_of_a_sheet_does_not_enter_its_support():
    sheet = make.block("sheet", "sheet.n.01", (0.2, 0.15, 0.003), {})
    tracks = grasp_tool_paths(sheet, Pose((0.0, 0.0, 0.7515)), (), 0.0, None)
    assert min(float(track.position[:, 2].min()) for track in tracks) >= 0.753 - SHEET_M - 1e-9


def test_sheet_is_picked_up_from_a_table(play):
    sheet = replace(make.block("sheet", "sheet.n.01", (0.2, 0.15, 0.003), {}), mass_kg=0.05)
    pose = upright(2.0, 1.3, TABLE_TOP_M, sheet)
    trace, simulator = play(
        [(placed("sheet_1", sheet, "kitchen_0", pose), sheet)], "move sheet_1; pick_up sheet_1"
    )
    assert trace.failure is None, trace.steps[-1].message
    assert simulator.world.carried == ("sheet_1",)


def goes_to_the_bottom(play, crate):
    die = replace(make.block("die", "die.n.01", (0.06, 0.06, 0.05), {}), mass_kg=0.1)
    extra = [
        (placed("crate_1", crate, "kitchen_0", upright(2.5, 2.6, 0.0, crate)), crate),
        (placed("die_1", die, "kitchen_0", upright(2.0, 1.3, TABLE_TOP_M, die)), die),
    ]
    trace, simulator = play(extra, "move die_1; pick_up die_1; move crate_1; place crate_1 inside")
    assert trace.failure is None, trace.steps[-1].message
    assert simulator.world.relations.inside("die_1", "crate_1")


def test_side_grasp_is_replaced_by_top_grasp_for_a_crate(play):
    crate = make.tub("crate", "crate.n.01", (0.24, 0.24, 0.2), 0.01, 0.01, mass_kg=1.0, abilities={})
    goes_to_the_bottom(play, crate)


def test_object_is_dropped_into_a_crate_too_narrow_for_the_hand(play):
    crate = make.tub("crate", "crate.n.01", (0.16, 0.16, 0.3), 0.01, 0.01, mass_kg=1.0, abilities={})
    goes_to_the_bottom(play, crate)


@pytest.mark.parametrize(("x", "yaw", "gap"), [(2.35, 0.0, 0.1), (1.7, 0.45, 0.0), (2.35, 0.45, 0.1)])
def test_regrasp_for_a_narrow_top_puts_the_hand_on_the_near_side(play, x, yaw, gap):
    # The roll does not fit across the heater, and the lockers block the hand's approach along the heater.
    roll = replace(make.block("roll", "roll.n.01", (0.2, 0.063, 0.032), {}), mass_kg=0.15)
    heater = make.block("heater", "heater.n.01", (0.084, 0.48, 1.84), {})
    locker = make.block("locker", "locker.n.01", (0.3, 0.3, 2.2), {})
    aside = 0.39 + gap
    extra = [
        (placed("heater_1", heater, "kitchen_0", upright(0.045, 2.0, 0.0, heater), fixed=True), heater),
        (
            placed("locker_1", locker, "kitchen_0", upright(0.15, 2.0 - aside, 0.0, locker), fixed=True),
            locker,
        ),
        (
            placed("locker_2", locker, "kitchen_0", upright(0.15, 2.0 + aside, 0.0, locker), fixed=True),
            locker,
        ),
        (placed("roll_1", roll, "kitchen_0", upright(x, 1.2, TABLE_TOP_M, roll, yaw)), roll),
    ]
    trace, simulator = play(extra, "move roll_1; pick_up roll_1; move heater_1; place heater_1 ontop")
    assert trace.failure is None, trace.steps[-1].message
    assert simulator.world.relations.ontop("roll_1", "heater_1")


@pytest.mark.parametrize(("wide_m", "yaw"), [(0.4, 0.0), (0.36, np.pi / 2)])
def test_object_that_fits_a_board_one_way_is_gripped_at_its_outer_side(play, wide_m, yaw):
    # The book is as long as the board is wide. It is put down temporarily with one end towards the robot.
    book = replace(make.block("book", "book.n.01", (0.32, 0.22, 0.02), {}), mass_kg=0.4)
    size = (0.26 + make.PANEL_M, wide_m + 2 * make.PANEL_M, 0.32)
    rack = make.open_shelf("rack", "rack.n.01", size, 2)
    stand = make.block("stand", "stand.n.01", (0.5, 0.5, 0.5), {})
    extra = [
        (placed("rack_1", rack, "kitchen_0", upright(0.25, 2.0, 0.7, rack), fixed=True), rack),
        (placed("stand_1", stand, "kitchen_0", upright(0.6, 2.85, 0.0, stand, yaw), fixed=True), stand),
        (placed("book_1", book, "kitchen_0", upright(2.4, 1.3, TABLE_TOP_M, book)), book),
    ]
    trace, simulator = play(extra, "move book_1; pick_up book_1; move rack_1; place rack_1 ontop")
    assert trace.failure is None, trace.steps[-1].message
    assert simulator.world.relations.ontop("book_1", "rack_1")


def test_cup_gripped_at_its_wall_stays_where_it_is_put(play):
    cup = make.tub("cup", "cup.n.01", (0.08, 0.08, 0.08), 0.003, 0.005, mass_kg=0.1, abilities={})
    pose = upright(2.0, 1.3, TABLE_TOP_M, cup)
    text = "move cup_1; pick_up cup_1; move countertop_1; place countertop_1 ontop"
    trace, simulator = play([(placed("cup_1", cup, "kitchen_0", pose), cup)], text)
    assert trace.failure is None, trace.steps[-1].message
    assert simulator.world.relations.ontop("cup_1", "countertop_1")
