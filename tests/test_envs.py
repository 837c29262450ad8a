"""The task as other people's learners meet it: their libraries' own checkers, and the arena stepped directly."""

import copy
import pickle
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from pettingzoo.test import parallel_api_test, parallel_seed_test
from pettingzoo.utils import aec_to_parallel, parallel_to_aec, wrappers

from lt_lib.comm.messages import CONTENT
from lt_lib.environments import gym
from lt_lib.environments.gym import ArenaEnv, ArenaVectorEnv
from lt_lib.environments.team import NAVIGATOR, SCOUT, TeamEnv
from lt_lib.envs.arena import HORIZON, Arena
from lt_lib.envs.camera import FastCamera, colours
from lt_lib.envs.geodesic import RouteDistance
from lt_lib.envs.layout import NO_CORRIDOR, load_layout
from lt_lib.pixels import episodes
from lt_lib.settings.base import UserError

ID = "lt_lib.environments.gym:LatentTelepathy/Corridors-v0"
ONE = np.ones(1, bool)


@pytest.fixture(scope="module")
def layout():
    return load_layout("default")


def drawn(layout, seed):
    """The scene of the first episode after `reset(seed=seed)`: spawn, slab and scout of an arena of one."""
    rng = np.random.default_rng(seed)
    spawn, scout = layout.spawn.sample(1, rng), layout.scout.sample(1, rng)
    return spawn, rng.integers(2, size=1), scout


def towards(pose, target):
    """The action that drives straight to a point (metres), whatever the heading."""
    dx, dy = np.subtract(target, pose[:2])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array([cos * dx + sin * dy, cos * dy - sin * dx, 0.0], np.float32) / 0.05


# --- the libraries' own checkers


@pytest.mark.filterwarnings("error::UserWarning")
def test_the_navigator_s_environment_passes_gymnasium_s_checker_without_a_warning():
    check_env(gymnasium.make(ID).unwrapped)


@pytest.mark.filterwarnings("error::UserWarning")
def test_the_team_passes_pettingzoo_s_checkers_without_a_warning(monkeypatch):
    monkeypatch.setattr(gym, "HORIZON", 40)  # so that the checker sees episodes end
    parallel_api_test(TeamEnv(), num_cycles=50)
    parallel_seed_test(TeamEnv, num_cycles=30)


# --- one navigator


def test_an_episode_is_the_arena_stepped_directly(layout):
    env, arena, camera = ArenaEnv(), Arena(layout, 1), FastCamera(layout)
    frame, info = env.reset(seed=5)
    spawn, slab, scout = drawn(layout, 5)
    arena.reset(ONE, spawn, slab, scout)
    rng, entered = np.random.default_rng(0), NO_CORRIDOR
    for action in rng.uniform(-0.5, 1, (60, 3)).astype(np.float32):
        np.testing.assert_array_equal(frame, colours(camera.frames(arena.pose, slab, scout[:, :2]))[0])
        assert info == {"slab": slab[0], "entered": entered, "contact": arena.contact[0]}
        frame, reward, terminated, truncated, info = env.step(action)
        arena.step(action[None])
        entered = arena.corridor[0] if entered == NO_CORRIDOR else entered
        assert (reward, terminated, truncated) == (-0.01 * arena.contact[0], False, False)


def follow(env, slab, waypoints):
    """Drives an episode with that slab past waypoints, then stands still; returns its length, return and last step."""
    seed = next(seed for seed in range(20) if env.reset(seed=seed)[1]["slab"] == slab)
    env.reset(seed=seed)
    waypoints, total, pose = list(waypoints), 0.0, env.unwrapped._scenes.arena
    for length in range(1, HORIZON + 2):
        if waypoints and np.hypot(*(pose.pose[0, :2] - waypoints[0])) < 0.1:
            waypoints.pop(0)
        action = towards(pose.pose[0], waypoints[0]) if waypoints else np.zeros(3, np.float32)
        _, reward, terminated, truncated, info = env.step(np.clip(action, -1, 1))
        total += reward
        if terminated or truncated:
            return length, total, terminated, truncated, info
    raise AssertionError("it never ends")


RIGHT = [(-1.8, -1.25), (0.3, -1.25), (0.3, -0.4), (1.7, -0.4)]


def test_it_ends_with_the_arrival_and_its_reward():
    length, total, terminated, truncated, info = follow(ArenaEnv(), 0, [*RIGHT, (2.3, -1.0), (6.0, 0.0)])
    assert (terminated, truncated, info["entered"]) == (True, False, 1)
    assert length < HORIZON and total == gym.ARRIVAL_REWARD


def test_a_step_in_contact_costs_and_an_episode_that_never_arrives_is_truncated_after_600():
    length, total, terminated, truncated, info = follow(ArenaEnv(), 1, [*RIGHT[:3], (0.85, -0.4)])
    assert (length, terminated, truncated) == (HORIZON, False, True)
    assert info == {"slab": 1, "entered": 1, "contact": True}
    assert -0.01 * HORIZON < total < -1


def test_the_reward_is_the_one_the_route_head_learns_from():
    assert (gym.ARRIVAL_REWARD, gym.CONTACT_REWARD) == (episodes.ARRIVAL_REWARD, episodes.CONTACT_REWARD)


def test_it_is_seen_from_above_as_a_picture_and_not_without_being_asked():
    env = gymnasium.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.ndim == 3 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 5
    assert ArenaEnv().render() is None


def test_an_unknown_layout_is_one_clear_line():
    with pytest.raises(UserError, match="^unknown layout 'mine'"):
        gymnasium.make(ID, layout="mine")


# --- many navigators


def test_every_row_of_the_vector_environment_is_an_environment_of_its_own_seed(monkeypatch):
    monkeypatch.setattr(gym, "HORIZON", 9)
    many, alone = gymnasium.make_vec(ID, num_envs=3), [ArenaEnv() for _ in range(3)]
    assert many.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    frames, _ = many.reset(seed=40)
    firsts = [env.reset(seed=40 + i) for i, env in enumerate(alone)]
    np.testing.assert_array_equal(frames, [frame for frame, _ in firsts])
    ended = False
    for action in np.random.default_rng(0).uniform(-1, 1, (25, 3, 3)).astype(np.float32):
        told = many.step(action)
        fresh = [
            (*env.reset()[:1], 0.0, False, False, {}) if ended else env.step(a)
            for env, a in zip(alone, action, strict=True)
        ]
        for got, expected in zip(told[:4], zip(*fresh, strict=True), strict=False):
            np.testing.assert_array_equal(got, np.array(expected))
        assert told[4]["slab"].tolist() == [env.unwrapped._scenes.info()["slab"] for env in alone]
        ended = told[3].all()
    assert many.observation_space.contains(told[0])


def test_rows_end_at_times_of_their_own():
    many = ArenaVectorEnv(num_envs=2)
    many.reset(seed=1)
    many._scenes._age[0] = HORIZON - 1
    many._scenes.entered[:] = 1
    still = np.zeros((2, 3), np.float32)
    assert many.step(still)[3].tolist() == [True, False]
    *_, truncated, infos = many.step(still)
    assert truncated.tolist() == [False, False]
    assert infos["entered"].tolist() == [NO_CORRIDOR, 1]
    assert many._scenes._age.tolist() == [0, 2]


# --- the team


@pytest.mark.parametrize("latency", [1, 3])
def test_a_message_arrives_late_by_the_latency_with_the_anchor_of_its_arrival(layout, latency):
    env, rng, sent = TeamEnv(latency=latency), np.random.default_rng(0), []
    observed, _ = env.reset(seed=3)
    assert not observed[NAVIGATOR]["wire"].any()
    arena = env._scenes.arena
    for _ in range(5):
        message, action = rng.normal(size=CONTENT).astype(np.float32), rng.uniform(-1, 1, 3).astype(np.float32)
        before = observed[NAVIGATOR]["wire"].copy()
        later = env.step({NAVIGATOR: action, SCOUT: message})[0]
        np.testing.assert_array_equal(observed[NAVIGATOR]["wire"], before)  # what was handed out stays
        sent.append(message)
        wire = later[NAVIGATOR]["wire"]
        if len(sent) < latency:
            assert not wire.any()
        else:
            offset = (arena.scout[0, :2] - arena.pose[0, :2]) / layout.communication_radius
            np.testing.assert_array_equal(wire[:2], offset.astype(np.float32))
            np.testing.assert_array_equal(wire[2:], sent[-latency])
        observed = later
    assert not env.reset()[0][NAVIGATOR]["wire"].any()


def test_a_message_cannot_arrive_before_it_is_sent():
    with pytest.raises(
        UserError, match="^latency: expected 1 or more control steps, since a message is an action, got 0$"
    ):
        TeamEnv(latency=0)


def test_the_team_shares_scene_reward_and_end_with_the_lone_navigator(layout):
    team, alone = TeamEnv(content=1), ArenaEnv()
    observed, _ = team.reset(seed=7)
    np.testing.assert_array_equal(observed[NAVIGATOR]["frame"], alone.reset(seed=7)[0])
    _, slab, scout = drawn(layout, 7)
    camera, silence = FastCamera(layout), np.zeros(1, np.float32)
    for action in np.random.default_rng(1).uniform(-1, 1, (20, 3)).astype(np.float32):
        observed, *told, infos = team.step({NAVIGATOR: action, SCOUT: silence})
        frame, *expected, info = alone.step(action)
        np.testing.assert_array_equal(observed[NAVIGATOR]["frame"], frame)
        assert [list(each.values()) for each in told] == [[value] * 2 for value in expected]
        assert infos == {NAVIGATOR: info, SCOUT: info}
    other = team._scenes.arena.pose[:, :2]
    np.testing.assert_array_equal(observed[SCOUT], colours(camera.frames(scout, slab, other))[0])
    beside_the_goal = np.array([[layout.goal.x - layout.goal.radius - 0.02, layout.goal.y, 0.0]])
    team._scenes.arena.reset(ONE, beside_the_goal, slab, scout)
    _, rewards, terminated, _, _ = team.step({NAVIGATOR: np.array([1, 0, 0], np.float32), SCOUT: silence})
    assert rewards == {NAVIGATOR: 1, SCOUT: 1} and terminated == {NAVIGATOR: True, SCOUT: True}
    assert team.agents == []


def test_out_of_range_nothing_arrives(layout):
    env = TeamEnv()
    env.reset(seed=0)
    env._scenes.arena.scout[:, 0] = 100.0
    observed, *_ = env.step({NAVIGATOR: np.zeros(3, np.float32), SCOUT: np.ones(CONTENT, np.float32)})
    assert not observed[NAVIGATOR]["wire"].any()


# --- what learners do with environments


@pytest.mark.parametrize("make", [ArenaEnv, lambda: ArenaVectorEnv(3)])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_bit_for_bit_and_leaves_the_original_alone(make, copied):
    env, rng = make(), np.random.default_rng(0)
    env.reset(seed=1)
    actions = rng.uniform(-1, 1, (30, *env.action_space.shape)).astype(np.float32)
    for action in actions[:15]:
        env.step(action)
    twin, third = copied(env), copied(env)
    for action in actions[15:]:
        for mine, its in zip(env.step(action), twin.step(action), strict=True):
            np.testing.assert_equal(mine, its)
    assert (env._scenes.arena.pose == twin._scenes.arena.pose).all()
    assert (third._scenes.arena.pose != env._scenes.arena.pose).any()
    np.testing.assert_equal(env.reset()[0], twin.reset()[0])  # the next draw of the scene, too


def test_a_copy_draws_its_own_pictures():
    env = ArenaEnv(render_mode="rgb_array")
    env.reset(seed=0)
    np.testing.assert_array_equal(copy.deepcopy(env).render(), env.render())


def test_a_copied_team_delivers_what_was_in_flight():
    env = TeamEnv(content=4, latency=3)
    env.reset(seed=0)
    said = {SCOUT: np.arange(4, dtype=np.float32), NAVIGATOR: np.zeros(3, np.float32)}
    env.step(said)
    twin = pickle.loads(pickle.dumps(env))
    quiet = said | {SCOUT: np.zeros(4, np.float32)}
    for _ in range(2):
        mine, its = env.step(quiet)[0][NAVIGATOR]["wire"], twin.step(quiet)[0][NAVIGATOR]["wire"]
        np.testing.assert_array_equal(mine, its)
    np.testing.assert_array_equal(mine[2:], said[SCOUT])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_or_message_that_is_not_finite_is_refused_with_its_environment(bad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    many = ArenaVectorEnv(3)
    many.reset(seed=0)
    actions = np.zeros((3, 3))
    actions[1, 2] = bad
    with pytest.raises(UserError, match=r"action of environment 1: .* finite numbers, got \[0.0, 0.0, (nan|inf)\]"):
        many.step(actions)
    team = TeamEnv()
    team.reset(seed=0)
    still, said = np.zeros(3), np.zeros(CONTENT)
    with pytest.raises(UserError, match="^message: expected finite numbers"):
        team.step({NAVIGATOR: still, SCOUT: np.full(CONTENT, bad)})
    with pytest.raises(UserError, match="^action: expected finite numbers"):
        team.step({NAVIGATOR: np.full(3, bad), SCOUT: said})
    arena = many._scenes.arena
    with pytest.raises(ValueError, match=r"state: qpos must be finite, of shape \(3, 3\)"):
        arena.restore(arena.state() | {"qpos": np.full((3, 3), bad)})
    assert not list(tmp_path.iterdir())  # MuJoCo logs into the current folder when its numbers blow up


@pytest.mark.parametrize("action, shape", [(np.zeros(2), r"\(2,\)"), (np.zeros((1, 3)), r"\(1, 3\)"), (0.5, r"\(\)")])
def test_an_action_of_another_shape_is_refused_with_the_shape_wanted(action, shape):
    env = ArenaEnv()
    env.reset(seed=0)
    with pytest.raises(UserError, match=rf"action: expected shape \(3,\), got {shape}"):
        env.step(action)
    with pytest.raises(UserError, match="action: expected numbers of shape"):
        env.step({"vx": 1})


def test_the_team_names_the_agents_whose_actions_it_misses():
    env = TeamEnv()
    env.reset(seed=0)
    with pytest.raises(UserError, match="actions: expected one for each of navigator, scout, got navigator"):
        env.step({NAVIGATOR: np.zeros(3)})
    with pytest.raises(UserError, match="got none"):
        env.step({})


def test_a_vector_run_keeps_gymnasium_s_promises_at_an_episode_s_end(monkeypatch):
    """Next-step reset: the last observation is the episode's own, and the next step ignores its action."""
    monkeypatch.setattr(gym, "HORIZON", 5)
    env = gymnasium.make_vec(ID, num_envs=3)
    env.reset(seed=0)
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    alone = ArenaEnv()
    alone.reset(seed=1)  # row 1's own
    ahead = np.tile(np.array([1.0, 0.2, 0.1], np.float32), (3, 1))
    for _ in range(5):
        frames, _, _, truncated, _ = env.step(ahead)
        last = alone.step(ahead[0])
    assert truncated.all() and last[3]
    np.testing.assert_array_equal(frames[1], last[0])
    frames, rewards, terminated, truncated, _ = env.step(ahead)
    fresh, _ = alone.reset()
    np.testing.assert_array_equal(frames[1], fresh)
    assert not rewards.any() and not terminated.any() and not truncated.any()


class Shaped(gymnasium.Wrapper):
    """The navigator's environment with the walking distance gained as reward, so that there is something to learn."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self._distance = RouteDistance(env.unwrapped._scenes.arena.layout)

    def _to_go(self) -> float:
        place = self.unwrapped._scenes.arena.pose[:, :2]
        return min(float(self._distance(place, np.array([side]))[0]) for side in (0, 1))

    def reset(self, **options):
        out = self.env.reset(**options)
        self._before = self._to_go()
        return out

    def step(self, action):
        frame, reward, *rest = self.env.step(action)
        before, self._before = self._before, self._to_go()
        return frame, reward + before - self._before, *rest


@pytest.mark.slow
def test_stable_baselines_ppo_learns_to_drive_forward():
    baselines = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    class Rewards(BaseCallback):
        means: ClassVar[list[float]] = []

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            self.means.append(float(self.model.rollout_buffer.rewards.mean()))

    env = make_vec_env(lambda: gymnasium.wrappers.TimeLimit(Shaped(ArenaEnv()), 64), n_envs=8, seed=0)
    model = baselines.PPO("CnnPolicy", env, n_steps=64, batch_size=128, n_epochs=4, seed=0)
    model.learn(4096, callback=Rewards())
    assert np.mean(Rewards.means[-2:]) > np.mean(Rewards.means[:2]) + 0.01  # metres per step


@pytest.mark.slow
def test_a_learner_trains_on_the_team_through_pettingzoo_s_wrappers():
    """REINFORCE on the scout: its message learns the number that the navigator's wire is rewarded for."""
    env = aec_to_parallel(wrappers.OrderEnforcingWrapper(parallel_to_aec(TeamEnv(content=1))))
    rng, mean, rewards = np.random.default_rng(0), np.zeros(1), []
    for episode in range(120):
        env.reset(seed=episode)
        said = (mean + rng.normal(size=1)).astype(np.float32)
        for _ in range(2):
            told, *_ = env.step({NAVIGATOR: np.zeros(3, np.float32), SCOUT: said})
        heard = told[NAVIGATOR]["wire"][2]
        assert heard == said[0]
        reward = -((heard - 2.0) ** 2)
        baseline = np.mean(rewards[-20:]) if rewards else reward
        mean = mean + 0.03 * np.clip(reward - baseline, -3, 3) * (said - mean)
        rewards.append(reward)
    assert np.mean(rewards[-30:]) > np.mean(rewards[:30]) + 1
