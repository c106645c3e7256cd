"""A motor turned to a count, by a firmware that counts limits from its own target and lets go there."""

import numpy as np
import pytest

from probewise.arm.nxt import BrickError, DriveParameters, Link, Motor, MotorError, NoAnswerError
from probewise.errors import LinkError, ReachError


@pytest.fixture
def motor(paper_brick, clock):
    return Motor(Link(paper_brick, clock=clock), 0, clock=clock)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_motor_comes_to_its_goal_from_the_same_side(motor, paper_brick, side):
    rng = np.random.default_rng(1)
    for goal in rng.integers(-2000, 2000, 30).tolist():
        here = motor.move_to(goal, side)
        assert abs(here - goal) <= 1
        assert paper_brick.motors[0].position == here
        assert np.sign(paper_brick.drives()[-1][1]) == side
        assert paper_brick.at_rest


def test_every_move_has_a_limit(motor, paper_brick):
    """The firmware's target is found without one: no dead line leaves a motor running."""
    paper_brick.motors[0].target = 5000  # as a program that ran before may have left it
    for goal in (300, -300, 0):
        motor.move_to(goal, 1)
    assert all(0 < limit < 1000 for _, _, limit in paper_brick.drives())


def test_the_target_is_found_where_the_motor_stands(motor, paper_brick):
    paper_brick.motors[0].target = -3000
    paper_brick.motors[0].position = 70
    assert motor.move_near(71) == 70
    assert not paper_brick.drives()
    assert paper_brick.motors[0].target == 70
    assert abs(motor.move_to(90, 1) - 90) <= 1


def test_the_coast_is_learned_whatever_it_is(motor, paper_brick):
    """A motor that runs on twice as far as first thought: once learned, two moves do."""
    paper_brick.motors[0].coast = 1.0
    for goal in (500, 1500, 700, 1800):
        motor.move_to(goal, 1)
    before = len(paper_brick.drives())
    motor.move_to(3500, 1)
    assert len(paper_brick.drives()) - before == 2


@pytest.mark.parametrize("lost", ["command", "answer"])
def test_a_move_whose_answer_does_not_come_is_never_made_twice(motor, paper_brick, lost):
    """Whether the command or its answer was lost, the motor comes to its goal, and never beyond it."""
    motor.move_to(0, 1)
    for goal in (600, 1300, 100, 900):
        paper_brick.lose[len(paper_brick.commands) + 1] = lost
        highest = max(goal, paper_brick.motors[0].position)
        assert abs(motor.move_to(goal, 1) - goal) <= 1
        assert paper_brick.motors[0].position <= highest + 1


def test_a_reset_makes_the_place_zero_and_the_target_is_still_known(motor, paper_brick):
    motor.move_to(500, 1)
    motor.reset_counter()
    assert abs(motor.counts()) == 0
    before = paper_brick.n_sought
    assert abs(motor.move_to(100, 1) - 100) <= 1
    assert paper_brick.motors[0].position == pytest.approx(600, abs=2)
    assert paper_brick.n_sought == before == 1


def changed(at, byte):
    """Put another byte into an answer, of which bytes 0 to 2 are type, opcode and status."""
    return lambda answer: answer[:at] + bytes([byte]) + answer[at + 1 :]


@pytest.mark.parametrize("at", range(3, 25))
@pytest.mark.parametrize("byte", [0x00, 0x5A])
def test_a_byte_of_a_state_that_was_changed_on_its_way_moves_nothing_astray(motor, paper_brick, at, byte):
    """Fields, three counters and run state, at every third of the questions that a move asks."""
    motor.move_to(0, 1)
    for goal in (600, 100):
        for k in range(4):
            paper_brick.alter[len(paper_brick.commands) + 3 * k] = lambda answer: (
                changed(at, byte)(answer) if answer[1] == 0x06 else answer
            )
        highest = max(goal, paper_brick.motors[0].position)
        assert abs(motor.move_to(goal, 1) - goal) <= 1
        assert motor.last_counts == paper_brick.motors[0].position <= highest + 1


def test_a_counter_that_is_another_every_time_is_told_of(motor, paper_brick):
    motor.move_to(0, 1)
    for k in range(20):
        paper_brick.alter[len(paper_brick.commands) + k] = changed(22, k + 1)
    with pytest.raises(MotorError, match="reports another state each of 6 times"):
        motor.counts()


def test_a_move_that_the_brick_refuses_is_worked_out_anew(motor, paper_brick):
    """A status may lie: what the brick says of its motor decides whether it took the move."""
    motor.move_to(0, 1)
    paper_brick.alter[len(paper_brick.commands) + 1] = changed(2, 0xDE)  # it took it all the same
    assert abs(motor.move_to(600, 1) - 600) <= 1
    assert paper_brick.motors[0].position <= 601


def test_a_brick_that_refuses_every_move_is_told_of(motor, paper_brick):
    motor.move_to(0, 1)
    write = paper_brick.write

    def refusing(data):
        paper_brick.statuses = {0x04: 0xDE} if data[3] == 0x04 and any(data[10:14]) else {}
        write(data)

    paper_brick.write = refusing
    with pytest.raises(BrickError, match="SETOUTPUTSTATE with status DE"):
        motor.move_to(600, 1)
    assert abs(paper_brick.motors[0].position) <= 1


def test_a_motor_in_whose_way_something_is_is_held_and_told_of(motor, paper_brick):
    motor.move_to(0, 1)
    paper_brick.motors[0].blocked_at = 120
    with pytest.raises(MotorError, match=r"motor A is stuck at 120 counts at power 60; is it plugged in"):
        motor.move_to(900, 1)
    assert paper_brick.at_rest
    paper_brick.motors[0].blocked_at = None
    assert abs(motor.move_to(900, 1) - 900) <= 1


def test_a_motor_that_runs_away_is_held(motor, paper_brick):
    """Its target has been moved behind our back, by another program's telegram say."""
    motor.move_to(0, 1)
    paper_brick.motors[0].target += 3000
    with pytest.raises(MotorError, match="runs on beyond"):
        motor.move_to(900, 1)
    assert paper_brick.at_rest
    assert paper_brick.motors[0].position < 1300


def test_a_motor_that_slips_is_given_up_after_some_moves(clock, paper_brick):
    paper_brick.motors[0].coast = 7.0
    motor = Motor(Link(paper_brick, clock=clock), 0, clock=clock, drive=DriveParameters(n_moves=2))
    with pytest.raises(MotorError, match="after 2 moves; is something in its way"):
        motor.move_to(500, 1)


def test_the_guard_is_asked_before_every_command_that_turns(clock, paper_brick):
    asked = []

    def guard(here, to):
        asked.append((here, to))
        if not -400 <= to <= 400:
            raise ReachError("motor", to, "-400 to 400")

    motor = Motor(Link(paper_brick, clock=clock), 0, clock=clock, guard=guard)
    motor.move_to(300, 1)
    for goal in (1000, -1000, 420):
        turned = len(paper_brick.drives())
        with pytest.raises(ReachError):
            motor.move_to(goal, 1)
        assert len(paper_brick.drives()) == turned or abs(paper_brick.motors[0].position) <= 401
    assert asked
    assert abs(paper_brick.motors[0].position) <= 401


def test_a_motor_that_a_program_drives_is_told_of(motor, paper_brick):
    carry_out = paper_brick.carry_out

    def meddled(opcode, body):
        answer = carry_out(opcode, body)
        if opcode == 0x04 and body[1] == 1:
            paper_brick.motors[0].command(paper_brick.clock.now_s, 50, 0x20, 0)
        return answer

    paper_brick.carry_out = meddled
    with pytest.raises(MotorError, match="does a program run on the brick"):
        motor.move_to(100, 1)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_stop_is_found_gently(motor, paper_brick, side):
    """By one limited move without regulation, which would press with all it has."""
    paper_brick.motors[0].blocked_at = side * 432
    paper_brick.motors[0].target = 9999
    assert motor.find_stop(side, 1000) == side * 432
    assert paper_brick.drives() == [(0, side * 30, 1000)]
    assert paper_brick.at_rest
    paper_brick.motors[0].blocked_at = None
    assert abs(motor.move_to(0, -side)) <= 1


def test_hold_and_release_are_what_the_firmware_calls_so(motor, paper_brick):
    motor.hold()
    motor.release()
    held, released = (body for body in paper_brick.commands if body[1] == 0x04)
    assert held == bytes.fromhex("00 04 00 00 07 01 00 20 00 00 00 00")
    assert released == bytes.fromhex("00 04 00 00 00 00 00 00 00 00 00 00")


def test_a_dead_line_is_an_error_within_its_deadline(motor, paper_brick, clock):
    motor.move_to(0, 1)
    paper_brick.lose = dict.fromkeys(range(len(paper_brick.commands), 10**4), "command")
    before = clock.now_s
    with pytest.raises(LinkError) as caught:
        motor.move_to(500, 1)
    assert not isinstance(caught.value, NoAnswerError)
    assert clock.now_s - before < 15
