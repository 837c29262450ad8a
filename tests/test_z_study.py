"""The point-mass study and the predictor: closed forms, a literal loop over single runs, and refusals."""

import numpy as np
import pytest
import torch
from scipy.special import expit
from scipy.stats import kstest, norm

from lt_lib.envs.layout import load_layout
from lt_lib.learnability import judgements as zstudy, point_mass, predictor, sigmoid
from lt_lib.learnability.score_function import ARMS, BASELINES, Episodes, Stack, gradient, play, train_point_mass
from lt_lib.learnability.windows import STREAMS, WORDS, normals
from lt_lib.report.claims import load_claims
from lt_lib.settings.base import UserError
from lt_lib.settings.learnability import UPDATES_PER_LOOK, PointMassConfig

SMALL = PointMassConfig(
    window=7,
    distances=(0.2, 0.6),
    sigmas=(0.5, 1.0),
    seeds=2,
    batch=16,
    budgets=(UPDATES_PER_LOOK, 2 * UPDATES_PER_LOOK),
    evaluation=64,
)
TASK = {"distance": 1.25, "speed": 0.5, "period": 0.1, "window": 30, "sigma": 0.601}
CURVE = predictor.Curve(centre=4.0, width=0.3, replicates=((3.9, 0.3), (4.1, 0.3)), made_of="a test")


def quiet(_: float) -> None:
    """A run's progress, unheard."""


def changed(config: PointMassConfig, **values) -> PointMassConfig:
    return PointMassConfig(**config.model_dump(exclude_computed_fields=True) | values)


# --- the learner
@pytest.mark.parametrize("arm", ["gaussian", "unclamped"])  # d below 1: the clamp changes no outcome of a single step
def test_score_function_gradient_is_the_closed_form_on_a_one_step_problem(arm):
    d, sigma, n = 0.3, 0.8, 2_000_000
    stack = Stack(1, np.array([[d]]), np.array([[sigma]]), np.array([[0]]))
    policy = np.array([[-0.2, 0.1]])
    (drawn,) = Episodes.batches(ARMS[arm], stack, [np.random.default_rng(0)], 1, n)
    entered, score = play(ARMS[arm], stack, policy, drawn)
    rewards = point_mass.reward(entered, drawn.safe)
    # by message: P(enter) = Phi((mu - d) / sigma); message 1 earns it, message 0 loses it, each in half the episodes
    slope = norm.pdf((policy - d) / sigma) / sigma
    expected = 0.5 * slope * np.array([[-1.0, 1.0]])
    for baseline in BASELINES.values():
        found = gradient(drawn.message, score, rewards - baseline(drawn.message, rewards))
        np.testing.assert_allclose(found, expected, atol=4 / np.sqrt(n))


def test_categorical_gradient_is_the_closed_form():
    n, logit = 1_000_000, np.array([[0.9, 2.0]])  # far from even, so that a wrong centre of the score shows
    stack = Stack(3, np.array([[0.9]]), np.array([[1.0]]), np.array([[0]]))
    (drawn,) = Episodes.batches(ARMS["categorical"], stack, [np.random.default_rng(1)], 1, n)
    entered, score = play(ARMS["categorical"], stack, logit, drawn)
    rewards = point_mass.reward(entered, drawn.safe)
    found = gradient(drawn.message, score, rewards - rewards.mean(1, keepdims=True))
    expected = 0.5 * expit(logit) * (1 - expit(logit)) * np.array([[-1.0, 1.0]])
    np.testing.assert_allclose(found, expected, atol=4 / np.sqrt(n))


@pytest.mark.parametrize("name", ARMS)
def test_the_message_tells_the_safe_side_but_in_the_control(name):
    stack = Stack(3, *(np.array([[value]]) for value in (0.5, 1.0, 0)))
    (drawn,) = Episodes.batches(ARMS[name], stack, [np.random.default_rng(4)], 1, 10_000)
    agree = (drawn.message == drawn.safe).mean()
    assert agree == pytest.approx(0.5, abs=0.02) if name == "no_signal" else agree == 1.0
    assert drawn.safe.mean() == pytest.approx(0.5, abs=0.02)


def noise_of(batch: Episodes, config: PointMassConfig) -> np.ndarray:
    """One run's standard normals, (B,) of the windows' means or (B, N) of their steps."""
    if config.arm == "unclamped":
        return batch.chance[0]
    return normals(batch.chance[0], config.batch * config.window).reshape(config.batch, config.window)


def literal_run(config: PointMassConfig, d: float, sigma: float, seed: int) -> np.ndarray:
    """One run, episode by episode: torch's normal density, automatic differentiation, torch's own optimisers."""
    arm, stack = ARMS[config.arm], Stack(config.window, *(np.array([[value]]) for value in (d, sigma, seed)))
    policy = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    kind = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}[config.optimiser]
    optimiser, generators = kind([policy], lr=config.lr, maximize=True), stack.generators(config.arm, 0)
    for _ in range(config.budgets[-1] // UPDATES_PER_LOOK):
        for batch in Episodes.batches(arm, stack, generators, UPDATES_PER_LOOK, config.batch):
            rewards, log_probs = [], []
            for bit, side, eps in zip(batch.message[0], batch.safe[0], noise_of(batch, config), strict=True):
                step = torch.distributions.Normal(policy[int(bit)], sigma if eps.ndim else sigma / config.window**0.5)
                command = (step.loc + step.scale * torch.as_tensor(eps, dtype=torch.float64)).detach()
                limit = np.inf if config.arm == "unclamped" else 1.0
                rewards.append(float((command.clamp(-limit, limit).mean() >= d) == side))
                log_probs.append(step.log_prob(command).sum())
            advantage = torch.tensor(rewards).double() - np.mean(rewards)
            optimiser.zero_grad()
            (advantage * torch.stack(log_probs)).mean().backward()
            optimiser.step()
    return policy.detach().numpy()


@pytest.mark.parametrize(
    ("arm", "optimiser"), [("gaussian", "adam"), ("gaussian", "sgd"), ("no_signal", "adam"), ("unclamped", "adam")]
)
def test_a_stacked_run_equals_the_plain_loop_over_single_runs(arm, optimiser):
    config = changed(SMALL, arm=arm, optimiser=optimiser, budgets=(UPDATES_PER_LOOK,))
    stacked = train_point_mass(config, 3, report=quiet)
    for row in (0, 5):
        alone = literal_run(config, *(stacked[name][row].item() for name in ("d", "sigma", "seed")))
        np.testing.assert_allclose(stacked["policy"][row, -1], alone, rtol=1e-6, atol=1e-9)
    assert np.abs(stacked["policy"]).min() > 0


@pytest.mark.parametrize("arm", ARMS)
def test_a_run_is_the_same_to_the_last_bit_whatever_runs_beside_it(arm):
    together = train_point_mass(changed(SMALL, arm=arm), 0, report=quiet)
    alone = train_point_mass(changed(SMALL, arm=arm, distances=(0.6,), sigmas=(0.5,), seeds=1), 1, report=quiet)
    row = np.flatnonzero((together["d"] == 0.6) & (together["sigma"] == 0.5) & (together["seed"] == 1)).item()
    for name, values in alone.items():
        np.testing.assert_array_equal(together[name][row], values[0])
    shorter = train_point_mass(changed(SMALL, arm=arm, budgets=(UPDATES_PER_LOOK,)), 0, report=quiet)
    np.testing.assert_array_equal(shorter["success"][:, 0], together["success"][:, 0])  # a budget is a look on the way
    assert len(np.unique(together["policy"][:, -1, 0])) == len(together["d"])  # no two runs share their draws


def test_the_mean_of_an_unclamped_window_has_the_distribution_and_the_score_of_its_steps():
    sigma, window, mean = 0.7, 12, 0.25
    stack = Stack(window, np.array([[0.5]]), np.array([[sigma]]), np.array([[0]]))
    noise = ARMS["unclamped"].chance(np.random.default_rng(5), (1, 20_000), stack)
    command, score = ARMS["unclamped"].act(np.full((1, 20_000), mean), noise, stack)
    np.testing.assert_allclose(score, window * (command - mean) / sigma**2)
    assert kstest(command[0], norm(mean, sigma / np.sqrt(window)).cdf).pvalue > 0.01


def test_commands_are_clamped_one_by_one_and_the_score_is_of_those_drawn():
    sigma, window, mean = 1.4, 9, -0.3
    stack = Stack(window, np.array([[0.5]]), np.array([[sigma]]), np.array([[0]]))
    seeds = ARMS["gaussian"].chance(np.random.default_rng(5), (1, 4_000), stack)
    command, score = ARMS["gaussian"].act(np.full((1, 4_000), mean), seeds, stack)
    drawn = mean + sigma * normals(seeds[0], 4_000 * window).reshape(1, 4_000, window).astype(float)
    np.testing.assert_allclose(command, np.clip(drawn, -1, 1).mean(-1), atol=1e-6)
    np.testing.assert_allclose(score, ((drawn - mean) / sigma**2).sum(-1), atol=1e-4)


def test_fast_normals_are_standard_normal_and_independent():
    seeds = np.random.default_rng(8).integers(0, 2**32, (250, WORDS, STREAMS), dtype=np.uint32)
    drawn = np.stack([normals(seed, 8_000) for seed in seeds]).astype(float)
    assert np.abs(drawn).max() < 6  # 24 bits: sqrt(-2 ln 2^-25)
    assert kstest(drawn.ravel(), norm.cdf).pvalue > 0.01
    n = drawn.size
    assert (np.abs(drawn) > 4).sum() == pytest.approx(2 * n * norm.sf(4), abs=4 * np.sqrt(2 * n * norm.sf(4)))
    for values in (drawn, drawn**2):
        centred = (values - values.mean()) / values.std()
        assert abs(np.corrcoef(centred[:-1].ravel(), centred[1:].ravel())[0, 1]) < 4 / np.sqrt(n)  # seeds
        for lag in (1, 2, STREAMS, 2 * STREAMS, 4_000):  # the two normals of a pair lie half the array apart
            assert abs((centred[:, :-lag] * centred[:, lag:]).mean()) < 4 / np.sqrt(n / 2)


def test_message_baseline_gives_no_gradient_where_all_episodes_of_a_message_end_alike():
    message = np.array([[True, True, False, False]])
    rewards = np.array([[0.0, 0.0, 1.0, 1.0]])
    assert (rewards - BASELINES["message"](message, rewards) == 0).all()
    assert (np.abs(rewards - BASELINES["batch"](message, rewards)) == 0.5).all()


def test_the_way_of_the_point_mass_adds_up_its_commands():
    path = point_mass.positions(np.array([[0.5, -1.0, 0.25]]))
    np.testing.assert_allclose(path, [[[0, 0], [1, 0.5], [2, -0.5], [3, -0.25]]])


# --- the predictor
def test_our_scene_has_the_printed_z_and_probability():
    claims = {name.removeprefix("port."): claim.paper for name, claim in load_claims().items() if name[:5] == "port."}
    task = predictor.scene_task(load_layout("default"), claims["sigma"])
    assert round(task.z, 1) == claims["z"] and round(task.d, 3) == claims["d"]
    assert (round(task.distance, 2), round(task.step, 2)) == (claims["distance"], claims["step"])
    assert task.window == 30 and round(np.log10(task.probability)) == round(np.log10(claims["prob"]))


def test_verdicts_come_from_the_curve_s_interval():
    verdicts = {sigma: predictor.ask(**TASK | {"sigma": sigma}, curve=CURVE).verdict for sigma in (0.601, 1.14, 2.0)}
    assert verdicts == {0.601: "unlearnable", 1.14: "borderline", 2.0: "learnable"}
    answer = predictor.ask(**TASK, curve=CURVE)
    assert answer.solved == pytest.approx(expit((4.0 - answer.z) / 0.3))
    assert "unlearnable: z = 7.59, probability 1.5e-14" in str(answer) and "a test" in str(answer)
    too_far = predictor.ask(**TASK | {"distance": 2.0, "sigma": 9.0}, curve=CURVE)  # z of 0.8, but d of 1.33
    assert too_far.verdict == "unlearnable" and "full command falls short" in str(too_far)


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"distance": -1.25}, "distance: must be a positive number of metres, got -1.25"),
        ({"distance": "1.25 m"}, "distance: must be a positive number of metres, got '1.25 m'"),
        ({"speed": 0.0}, "speed: must be a positive number of m/s"),
        ({"period": 0}, "period: must be a positive number of seconds, got 0"),
        ({"sigma": 0.0}, "sigma: must be a positive number of full commands"),
        ({"sigma": float("nan")}, "sigma: must be a positive number of full commands, got nan"),
        ({"window": 30.5}, "window: must be a whole number of control steps"),
        ({"window": 0}, "window: must be a whole number of control steps, at least 1, got 0"),
        ({"distance": 125.0}, "distance: 125 m is 83 times what full speed covers"),
        ({"period": 100.0}, "period: one step of full command covers 50 m"),
        ({"period": 10.0}, "is it in milliseconds or Hz"),
        ({"sigma": 60.1}, "sigma: 60.1 full commands"),
    ],
)
def test_impossible_values_and_other_units_are_refused_in_one_line(wrong, line):
    with pytest.raises(UserError) as caught:
        predictor.ask(**TASK | wrong, curve=CURVE)
    assert line in str(caught.value) and "\n" not in str(caught.value)


def test_curves_are_read_from_what_the_study_kept(tmp_path):
    path = tmp_path / predictor.CURVES
    with pytest.raises(UserError, match="no curve at .*run_all.py --only z_study"):
        predictor.load_curve(path=path)
    other = CURVE.model_copy(update={"centre": 5.0})
    zstudy.keep_curves({"100 updates": CURVE, "200 updates": other}, "200 updates", tmp_path)
    assert predictor.load_curve(path=path) == other and predictor.load_curve("100 updates", path) == CURVE
    with pytest.raises(UserError, match="no curve '7 updates'; known: 100 updates, 200 updates"):
        predictor.load_curve("7 updates", path)
    path.write_text(path.read_text().replace('"width": 0.3', '"width": 0.4'))
    with pytest.raises(UserError, match="learnability.json: was altered"):
        predictor.load_curve(path=path)


# --- the analysis
def counts(centre: np.ndarray | float, width: float, n: int = 5):
    z = np.random.default_rng(2).uniform(0.3, 12, 400)
    return z, np.random.default_rng(3).binomial(n, expit((centre - z) / width))


def test_the_sigmoid_fit_recovers_a_known_centre_and_its_interval_holds_it():
    z, solved = counts(4.2, 0.5)
    centre, width = sigmoid.fit(z, solved, 5)
    assert centre == pytest.approx(4.2, abs=0.15) and width == pytest.approx(0.5, abs=0.1)
    replicates = sigmoid.bootstrap(z, solved, 5, 100, np.random.default_rng(0))
    low, high = np.quantile(replicates[:, 0], (0.025, 0.975))
    assert low < 4.2 < high and high - low < 0.5
    assert sigmoid.fit(np.array([1.0, 2.0, 6.0, 7.0]), np.array([5, 5, 0, 0]), 5)[0] == pytest.approx(4.0, abs=2.0)


def test_window_length_is_found_where_it_matters_and_not_where_it_does_not():
    group = np.arange(400) % 3
    z, solved = counts(4.2, 0.5)
    assert sigmoid.compare(z, group, solved, 5).p > 0.05
    z, solved = counts(np.array([3.5, 4.2, 5.0])[group], 0.5)
    compared = sigmoid.compare(z, group, solved, 5)
    assert compared.p < 1e-6
    np.testing.assert_allclose(compared.centres, [3.5, 4.2, 5.0], atol=0.25)


def test_separation_and_the_best_of_fair_coins_equal_their_definitions():
    solved = np.array([True, True, False, False])
    assert zstudy.separation(solved, np.array([0.3, 0.4, 0.1, 0.2])) == 1.0
    assert zstudy.separation(solved, np.array([0.3, 0.1, 0.1, 0.2])) == 0.625
    best = np.random.default_rng(0).binomial(1000, 0.5, (4000, 240)).max(1) / 1000
    low, high = zstudy.fair_coin_best(240, 1000)
    assert 0.93 < np.mean((low <= best) & (best <= high)) < 0.99


def test_even_odds_of_one_arrival():
    z = zstudy.hit_edge(64_000.0)
    assert 1 - (1 - norm.sf(z)) ** 64_000 == pytest.approx(0.5, abs=1e-6)


def test_a_wider_sigmoid_is_told_from_a_narrower_one_and_not_from_an_equal_one():
    z, wide = counts(4.2, 1.5)
    narrow, same = counts(4.2, 0.3)[1], np.random.default_rng(9).binomial(5, expit((4.2 - z) / 1.5))
    first, second, p = sigmoid.wider(z, wide, narrow, 5)
    assert (first, second) == (pytest.approx(1.5, rel=0.3), pytest.approx(0.3, rel=0.3)) and p < 1e-6
    assert sigmoid.wider(z, narrow, wide, 5)[2] > 0.99
    assert 0.02 < sigmoid.wider(z, wide, same, 5)[2] < 0.98
