import math

import numpy as np
import pytest

from env_door.twin.arm import MAX_ACCELERATION, TIME_STEP, JointMotion


def motion(start=0.0, speed=3.0):
    made = JointMotion(np.full(6, -6.0), np.full(6, 6.0), np.full(6, speed))
    made.hold(np.full(6, start))
    return made


def run(made, seconds):
    positions = []
    for _ in range(round(seconds / TIME_STEP)):
        made.step()
        positions.append(made.position[0])
    return np.array(positions)


def test_servo_is_the_damped_oscillator_of_its_gain_and_lookahead():
    gain, lookahead, step = 300.0, 0.1, 0.01
    made = motion()
    made.servo(np.full(6, step), lookahead, gain)
    positions = run(made, 0.6)
    frequency, damping = math.sqrt(gain), lookahead * math.sqrt(gain) / 2
    damped = frequency * math.sqrt(1 - damping**2)
    times = np.arange(1, len(positions) + 1) * TIME_STEP
    decay = np.exp(-damping * frequency * times)
    ratio = damping / math.sqrt(1 - damping**2)
    expected = step * (1 - decay * (np.cos(damped * times) + ratio * np.sin(damped * times)))
    np.testing.assert_allclose(positions, expected, atol=0.02 * step)


def test_a_ramp_is_trailed_by_the_lookahead_time():
    made, speed = motion(), 0.5
    for tick in range(1000):
        made.servo(np.full(6, speed * tick * TIME_STEP), 0.1, 300.0)
        made.step()
    assert speed * 999 * TIME_STEP - made.position[0] == pytest.approx(speed * 0.1, abs=2e-3)


def test_servo_keeps_to_speed_acceleration_and_joint_range():
    made = motion(speed=2.0)
    made.servo(np.full(6, 100.0), 0.03, 2000.0)
    positions = np.concatenate([[0.0], run(made, 4.0)])
    velocity = np.diff(positions) / TIME_STEP
    assert np.abs(velocity).max() <= 2.0 + 1e-9
    assert np.diff(velocity).max() <= MAX_ACCELERATION * TIME_STEP + 1e-9
    assert positions.max() <= 6.0


@pytest.mark.parametrize("distance", [0.5, 0.01], ids=["with a cruise", "too short for one"])
def test_move_takes_the_time_of_a_trapezoid_and_arrives(distance):
    speed, acceleration = 0.4, 1.0
    made = motion()
    target = np.array([distance, -distance / 2, 0, 0, 0, 0])
    made.move(target, speed, acceleration)
    steps = 0
    while made.kind == "move":
        made.step()
        steps += 1
        assert made.position[1] == pytest.approx(-made.position[0] / 2)
    ramp = speed**2 / acceleration
    expected = distance / speed + speed / acceleration if distance > ramp else 2 * math.sqrt(distance / acceleration)
    assert steps * TIME_STEP == pytest.approx(expected, abs=2 * TIME_STEP)
    np.testing.assert_array_equal(made.position, target)


def test_a_move_to_where_it_is_ends_at_once():
    made = motion(0.3)
    made.move(np.full(6, 0.3), 1.0, 1.0)
    assert made.kind == "hold"


def test_stop_brakes_within_the_distance_of_constant_deceleration():
    made = motion()
    made.move(np.full(6, 5.0), 1.0, 10.0)
    before = run(made, 0.5)[-1]
    made.stop(2.0)
    after = run(made, 1.0)[-1]
    assert made.kind == "hold"
    assert not made.velocity.any()
    assert after - before == pytest.approx(1.0**2 / (2 * 2.0), abs=5e-3)
