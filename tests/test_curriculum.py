"""The curriculum's two rules, its window, and its exact resume (Sec. IV-C)."""

import numpy as np
import pytest

from tdgc.tasks.curriculum import Curriculum

W, S, LEVELS = 10, 8, 11  # promoted at 8 or more of 10, demoted at 2 or fewer


def update_level(level, successes, window, threshold, max_level):
    """Levels of environments at ``level`` after a window that begins with so many successes."""
    level, successes = np.broadcast_arrays(np.atleast_1d(level), successes)
    curriculum = Curriculum(len(level), window, threshold, max_level, start=level)
    for episode in range(window):
        curriculum.push(np.arange(len(level)), episode < successes)
    return curriculum.levels


@pytest.mark.parametrize(
    ("successes", "change"),
    [(0, -1), (1, -1), (2, -1), (3, 0), (5, 0), (7, 0), (8, 1), (9, 1), (10, 1)],
)
def test_rules_at_every_edge(successes, change):
    assert update_level(5, successes, W, S, LEVELS) == 5 + change


def test_levels_stop_at_both_ends():
    assert update_level(10, 10, W, S, LEVELS) == 10
    assert update_level(9, 10, W, S, LEVELS) == 10
    assert update_level(0, 0, W, S, LEVELS) == 0
    assert update_level(1, 0, W, S, LEVELS) == 0
    assert update_level(0, 10, W, S, 1) == 0


def test_rules_on_arrays():
    levels = update_level([0, 0, 4, 4, 4, 10], [0, 8, 2, 3, 8, 10], W, S, LEVELS)
    assert levels.tolist() == [0, 1, 3, 4, 5, 10]


@pytest.mark.parametrize(("window", "threshold"), [(10, 5), (9, 5), (10, 11), (1, 1), (4, 2)])
def test_rules_that_overlap_are_refused(window, threshold):
    with pytest.raises(ValueError, match=rf"not {threshold} with a window of {window}$"):
        Curriculum(1, window, threshold, LEVELS)


@pytest.mark.parametrize(("window", "threshold"), [(10, 6), (9, 6), (2, 2), (20, 16)])
def test_smallest_thresholds_never_overlap(window, threshold):
    counts = np.arange(window + 1)
    levels = update_level(np.full(window + 1, 5), counts, window, threshold, LEVELS)
    assert (levels == 6).tolist() == (counts >= threshold).tolist()
    assert (levels == 4).tolist() == (counts < window - threshold + 1).tolist()
    assert (levels == 5).sum() == 2 * threshold - window - 1 > 0


def play(curriculum: Curriculum, outcomes: str) -> list[int]:
    """Levels of environment 0 after each episode; ``outcomes`` has 1 for success, 0 for failure."""
    levels = []
    for outcome in outcomes:
        curriculum.push(np.array([0]), np.array([outcome == "1"]))
        levels.append(int(curriculum.levels[0]))
    return levels


def test_nothing_moves_before_the_window_is_full_and_it_empties_after_a_change():
    curriculum = Curriculum(1, 4, 3, LEVELS)
    # promoted by the 4th episode, then by the 8th: the first four count only once
    assert play(curriculum, "11111111111") == [0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2]
    assert curriculum.counts.tolist() == [3]
    # 1000 has one success, below W - S + 1 = 2, and demotes
    curriculum = Curriculum(1, 4, 3, LEVELS, start=5)
    assert play(curriculum, "10000000") == [5, 5, 5, 4, 4, 4, 4, 3]
    assert curriculum.counts.tolist() == [0] and not curriculum.outcomes.any()


def test_window_slides_while_the_level_holds():
    curriculum = Curriculum(1, 4, 3, LEVELS, start=5)
    # 0011 holds (2 of 4); one more success makes 0111 and promotes at the 5th episode
    assert play(curriculum, "00111") == [5, 5, 5, 5, 6]
    curriculum = Curriculum(1, 4, 3, LEVELS, start=5)
    # 1100 holds, 1001 holds, 0010 demotes at the 6th
    assert play(curriculum, "110010") == [5, 5, 5, 5, 5, 4]


def test_top_level_keeps_sliding():
    curriculum = Curriculum(1, 4, 3, LEVELS, start=10)
    assert play(curriculum, "11111") == [10] * 5
    assert curriculum.counts.tolist() == [4]
    # 1110, 1100, 1000: the third failure demotes, as the window was never cleared
    assert play(curriculum, "000") == [10, 10, 9]


def test_environments_are_independent():
    curriculum = Curriculum(4, 2, 2, LEVELS, start=[0, 3, 10, 5])
    curriculum.push(np.arange(4), np.array([True, False, True, True]))
    assert curriculum.levels.tolist() == [0, 3, 10, 5]
    # environment 3 does not end; the others complete their windows, in another order
    curriculum.push(np.array([2, 0, 1]), np.array([True, True, False]))
    assert curriculum.levels.tolist() == [1, 2, 10, 5]
    assert curriculum.counts.tolist() == [0, 0, 2, 1]
    curriculum.push(np.array([2, 3]), np.array([False, False]))
    assert curriculum.levels.tolist() == [1, 2, 10, 5]
    assert curriculum.outcomes.tolist() == [[False] * 2, [False] * 2, [True, False], [True, False]]


def test_nothing_to_push():
    curriculum = Curriculum(3, W, S, LEVELS)
    curriculum.push(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool))
    assert curriculum.counts.tolist() == [0, 0, 0]


def test_many_random_episodes_against_the_rules_written_out():
    rng = np.random.default_rng(0)
    n, window, threshold, levels = 20, 6, 5, 5
    curriculum = Curriculum(n, window, threshold, levels, start=2)
    level, windows = [2] * n, [[] for _ in range(n)]
    seen = set()
    for step in range(400):
        ended = rng.random(n) < 0.4
        reached = rng.random(n) < 0.5 + 0.4 * np.sin(step / 40)
        curriculum.push(np.flatnonzero(ended), reached[ended])
        for i in np.flatnonzero(ended):
            windows[i] = [*windows[i], bool(reached[i])][-window:]
            if len(windows[i]) == window:
                c, old = sum(windows[i]), level[i]
                if c >= threshold:
                    level[i] = min(level[i] + 1, levels - 1)
                if c < window - threshold + 1:
                    level[i] = max(level[i] - 1, 0)
                if level[i] != old:
                    windows[i] = []
        assert curriculum.levels.tolist() == level
        assert curriculum.counts.tolist() == [len(w) for w in windows]
        seen.update(level)
    assert seen == {0, 1, 2, 3, 4}


@pytest.mark.parametrize("start", [-1, 11, [0, 0, 11]])
def test_start_must_be_a_level(start):
    with pytest.raises(ValueError, match=r"0\.\.10"):
        Curriculum(3, W, S, LEVELS, start=start)


def test_resume_is_exact():
    rng = np.random.default_rng(1)

    def run(curriculum: Curriculum, episodes: np.ndarray) -> None:
        for row in episodes:
            curriculum.push(np.arange(8), row)

    episodes = rng.random((60, 8)) < 0.7
    through = Curriculum(8, 5, 4, LEVELS)
    run(through, episodes)
    first, second = Curriculum(8, 5, 4, LEVELS), Curriculum(8, 5, 4, LEVELS)
    run(first, episodes[:33])
    state = first.state_dict()
    run(first, episodes[33:])  # the state is a copy: further episodes must not change it
    second.load_state_dict(state)
    run(second, episodes[33:])
    assert through.levels.tolist() == second.levels.tolist() == first.levels.tolist()
    assert through.levels.max() > 2
    assert np.array_equal(through.outcomes, second.outcomes)
    assert np.array_equal(through.counts, second.counts)


def test_state_of_another_curriculum_is_refused():
    state = Curriculum(3, 5, 4, LEVELS, start=10).state_dict()
    for curriculum, message in (
        (Curriculum(4, 5, 4, LEVELS), r"'levels' has shape \(3,\), not \(4,\)"),
        (Curriculum(3, 6, 4, LEVELS), r"'outcomes' has shape \(3, 5\), not \(3, 6\)"),
        (Curriculum(3, 5, 4, 6), "'levels' must be in 0..5"),
    ):
        with pytest.raises(ValueError, match=message):
            curriculum.load_state_dict(state)
    del state["counts"]
    with pytest.raises(ValueError, match="the state lacks 'counts'"):
        Curriculum(3, 5, 4, LEVELS).load_state_dict(state)
