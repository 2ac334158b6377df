"""Every experiment, by name.

To add one, write its set-ups in setups.py, and the experiment here.
"""

from typing import Final

from benchmarks.thesis import claims
from benchmarks.thesis.experiment import Chain, Curves, Experiment, Friction, KernelError, Transfer
from benchmarks.thesis.setups import EARLY, OBJECTS, WIDE

_MANY: Final = 30  # trials, where those of five differ too much to decide

_CLAIMS: Final = [
    Experiment(
        name="fig-4.1",
        title="Direct learning: late success, then a race to the bottom",
        question="What happens when the weights of the features are learnt directly?",
        claim=(
            "Returns are flat for 50 to 70 generations, peak by about generation 100, and then fall"
            " without bound, while actions grow to 100 times the joint range. The grip does not"
            " change (4.1.1)."
        ),
        curves={"direct, D 100, N 50": "direct-contacts-N50"},
        figure=Curves(panels=("return", "action"), scale="symlog"),
        find=claims.race,
    ),
    Experiment(
        name="fig-4.2",
        title="Convergence of mu and sigma",
        question="Does the search distribution converge when parameters are projected?",
        claim="Sigma goes to 0 and mu converges, to a different value in each trial (4.2.1).",
        curves={"projected, joints+contacts, D 1500": "contacts-D1500"},
        figure=Curves(panels=("mu_2", "sigma_2")),
        find=claims.converges,
    ),
    Experiment(
        name="fig-4.3",
        title="Number of features",
        question="How does learning depend on the number of random features?",
        claim=(
            "With more features learning is faster, ends with higher returns, and differs less"
            " between trials. With 300 features nothing is learnt in 150 generations (4.2.2)."
        ),
        curves={
            "D 300": "joints-D300-30",
            "D 1500": "joints-D1500-30",
            "D 8000": "joints-D8000-30",
        },
        find=claims.features,
        trials=_MANY,
    ),
    Experiment(
        name="fig-4.4",
        title="State bases",
        question=(
            "Which state should the controller observe: joint positions, contact points, or the"
            " tactile image?"
        ),
        claim=(
            "With joint positions learning is fastest and returns are highest; with joint positions"
            " and the tactile image learning is slowest (4.2.3)."
        ),
        curves={
            "joints, D 1500": "joints-D1500",
            "joints+contacts, D 1500": "contacts-D1500",
            "joints+tactile, D 5400": "joints-tactile-D5400",
        },
        find=claims.states,
    ),
    Experiment(
        name="fig-4.5",
        title="Pairs per generation",
        question="Few pairs and many updates, or many pairs and few updates?",
        claim=(
            "With N 50 returns rise at generation 30 to 40, drop, and recover. With N 15 they rise"
            " at generation 90, more smoothly and nearly as high (4.2.4)."
        ),
        curves={"N 50": "contacts-D1500-N50", "N 15": "contacts-D1500"},
        find=claims.pairs_per_generation,
    ),
    Experiment(
        name="fig-4.6",
        title="Pairs per generation, over rollouts",
        question="Which N learns more from the same number of rollouts?",
        claim=(
            "What matters is the number of rollouts; with a small N learning is faster (4.2.4). The"
            " thesis counts histories, which are two rollouts each."
        ),
        curves={"N 50": "contacts-D1500-N50", "N 15": "contacts-D1500"},
        figure=Curves(over="rollouts"),
        find=claims.rollouts_count,
    ),
    Experiment(
        name="text-8000",
        title="The best set-up",
        question="Is the gait learnt within 90 generations?",
        claim=(
            "With joint positions, D 8000 and N 15 the gait is learnt in fewer than 90 generations,"
            " and sigma has converged after 50 (5, 5.2)."
        ),
        curves={"joints, D 8000": "joints-D8000"},
        figure=Curves(panels=("return", "success", "sigma")),
        find=claims.learnt_within_90,
    ),
    Experiment(
        name="text-4.1.1",
        title="Remedies for direct learning",
        question=(
            "Is direct learning stable with limits on the actions, with a limited punishment of"
            " large actions, or with lower initial values?"
        ),
        claim=(
            "No. With limited actions every action reaches its limit within 10 generations and does"
            " not leave it within 100. Lower initial mu and sigma do not help (4.1.1)."
        ),
        curves={
            "unlimited": "direct-contacts-N50",
            "clipped": "direct-contacts-N50-clipped",
            "punishment limited": "direct-contacts-N50-limited",
            "clipped, punishment limited": "direct-contacts-N50-both",
            "low mu and sigma": "direct-contacts-N50-low",
        },
        figure=Curves(panels=("return", "action"), scale="symlog"),
        find=claims.remedies,
    ),
    Experiment(
        name="text-4.1.2",
        title="Direct learning: histories per generation",
        question=(
            "Does the number of histories per generation, N, affect direct learning over 2000"
            " histories?"
        ),
        claim=(
            "There is no difference within 2000 histories, during which returns stay flat (4.1.2)."
        ),
        curves={
            "N 15": "direct-contacts-N15-short",
            "N 25": "direct-contacts-N25-short",
            "N 50": "direct-contacts-N50-short",
            "N 100": "direct-contacts-N100-short",
        },
        figure=Curves(over="rollouts", scale="symlog"),
        find=claims.no_difference,
    ),
    Experiment(
        name="text-4.3",
        title="Direct and projected learning compared",
        question="How do direct and projected learning compare, with the same state and N?",
        claim="Both rise alike; then both drop, and only projected learning recovers (4.3).",
        curves={"direct, D 100": "direct-contacts-N50", "projected, D 1500": "contacts-D1500-N50"},
        figure=Curves(scale="symlog"),
        find=claims.only_projected_recovers,
    ),
    Experiment(
        name="text-3.5.2",
        title="Scaled returns",
        question="Does the scale of the returns matter?",
        claim="Learning does not change when returns are scaled (3.5.2).",
        curves={
            "returns x1": "joints-D8000",
            "returns x128": "joints-D8000-returns-x128",
            "returns x100": "joints-D8000-returns-x100",
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.scale_free,
    ),
    Experiment(
        name="table-3.2",
        title="Number of features for an accuracy",
        question="How many features are needed for a given accuracy of the kernel?",
        claim=(
            "D = d eps^-2 log(1/eps^2): for eps 0.1, 1600 features for 8 numbers to 12600 for 63"
            " (table 3.2)."
        ),
        figure=KernelError(features=(30, 90, 280, 560, 1600, 3400, 5400, 12600)),
        find=claims.kernel_error,
    ),
]

_QUESTIONS: Final = [
    Experiment(
        name="why-features",
        title="Does the noise of the approximation matter?",
        question=(
            "Few features approximate the kernel badly. Does this noise hinder learning, or does it"
            " help exploration? The exact kernel has none."
        ),
        curves={
            "D 300": "joints-D300-30",
            "D 1500": "joints-D1500-30",
            "D 8000": "joints-D8000-30",
            "kernel": "joints-kernel-30",
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
        trials=_MANY,
    ),
    Experiment(
        name="why-start",
        title="Does the start of the search matter?",
        question=(
            "With mu = 1 the policy squeezes the bar at once, and with sigma = 2 most samples do"
            " nothing. What changes with a start near the held grip (mu 1.75, sigma 0.8), with"
            " capped steps of sigma, with both, and with the derived normaliser?"
        ),
        curves={
            "as in the thesis": "joints-D8000",
            "near start": "joints-D8000-near",
            "sigma capped": "joints-D8000-capped",
            "near and capped": "joints-D8000-near-capped",
            "derived normaliser": "joints-D8000-sehnke",
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
    ),
    Experiment(
        name="why-race",
        title="What causes the race to the bottom?",
        question=(
            "Does direct learning also diverge with a different normaliser, or without symmetric"
            " sampling and normalisation (thesis 3.1)?"
        ),
        curves={
            "as in the thesis": "direct-contacts-N50",
            "derived normaliser": "direct-contacts-N50-derived",
            "plain, not normalised": "direct-contacts-N50-plain",
        },
        figure=Curves(panels=("return", "action"), scale="symlog"),
        find=claims.learning,
    ),
    Experiment(
        name="why-contacts",
        title="Contact points, or the start of the search?",
        question=(
            "In the kernel, moving a contact point by one fingertip radius counts as much as"
            " turning a joint by 57 degrees. Do contact points hinder less if they are scaled down?"
            " Or is the cause that nine more numbers put the initial mean so far from every state"
            " that the kernel is zero, and does a width of 2 compensate for this?"
        ),
        curves={
            "joints alone": "default-bar",
            "contacts x1": "default-contacts",
            "contacts x0.3": "default-contacts-x0.3",
            "contacts x0.1": "default-contacts-x0.1",
            "contacts x1, h 2": "default-contacts-h2",
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
    ),
    Experiment(
        name="cosine",
        title="Direct learning with bounded parameters",
        question=(
            "Thesis 5.2: does direct learning work if actions depend on the cosine of the"
            " parameters?"
        ),
        curves={
            "direct, D 100": "direct-joints-N15-projected-weights",
            "cosine, D 100": "cosine-joints-D100",
            "cosine, D 1500": "cosine-joints-D1500",
            "projected, D 1500": "joints-D1500",
        },
        figure=Curves(scale="symlog"),
        find=claims.learning,
    ),
    Experiment(
        name="direct-few",
        title="Direct learning with few rollouts",
        question=(
            "Thesis 5: does direct learning work on joint positions alone, with few histories per"
            " generation?"
        ),
        curves={
            "N 5": "direct-joints-N5",
            "N 15": "direct-joints-N15",
            "N 50": "direct-joints-N50",
            "N 15, default preset, from 0": "default-direct",
        },
        figure=Curves(over="rollouts", scale="symlog"),
        find=claims.learning,
    ),
    Experiment(
        name="equal-accuracy",
        title="State bases at equal kernel accuracy",
        question=(
            "Thesis 5: how do the state bases compare if each has as many features as an accuracy"
            " of 10 % needs?"
        ),
        curves={
            "joints, D 1600": "joints-D1600",
            "joints+contacts, D 3400": "contacts-D3400",
            "tactile, D 10800": "tactile-D10800",
            "joints+tactile, D 12600": "joints-tactile-D12600",
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
    ),
    Experiment(
        name="start-fitted",
        title="A start that fits the size of the state",
        question=(
            "At the thesis' start a Gaussian kernel of 17, 54 or 62 numbers is zero. Which state"
            " bases are learnt after 1500 rollouts if the kernel's width and the initial sigma are"
            " chosen so that the kernel's exponent is about two at the initial mean, and sampling"
            " changes it by about one?"
        ),
        curves={
            f"{state}, {start}": f"{name}{suffix}"
            for start, suffix in (("fitted", "-fitted"), ("printed", ""))
            for state, name in EARLY.items()
        },
        figure=Curves(panels=("mean policy", "success"), over="rollouts"),
        find=claims.mostly_learnt,
    ),
    Experiment(
        name="fig-4.2-fitted",
        title="Convergence of mu and sigma, from the fitted start",
        question="Does the search distribution converge if the start fits the size of the state?",
        claim="Sigma goes to 0 and mu converges, to a different value in each trial (4.2.1).",
        curves={"projected, joints+contacts, D 1500": "contacts-D1500-fitted"},
        figure=Curves(panels=("mu_2", "sigma_2")),
        find=claims.converges,
    ),
    Experiment(
        name="fig-4.4-fitted",
        title="State bases, from the fitted start",
        question=(
            "Which state should the controller observe, if each state has a start that fits its"
            " size?"
        ),
        claim=(
            "With joint positions learning is fastest and returns are highest; with joint positions"
            " and the tactile image learning is slowest (4.2.3)."
        ),
        curves={
            "joints, D 1500": "joints-D1500-fitted",
            "joints+contacts, D 1500": "contacts-D1500-30-fitted",
            "joints+tactile, D 5400": "joints-tactile-D5400-30-fitted",
        },
        find=claims.states,
        trials=_MANY,
    ),
    Experiment(
        name="fig-4.5-fitted",
        title="Pairs per generation, from the fitted start",
        question=(
            "Few pairs and many updates, or many pairs and few updates, if the start fits the size"
            " of the state?"
        ),
        claim=(
            "With N 50 returns rise at generation 30 to 40, drop, and recover. With N 15 they rise"
            " at generation 90, more smoothly and nearly as high (4.2.4)."
        ),
        curves={"N 50": "contacts-D1500-N50-fitted", "N 15": "contacts-D1500-30-fitted"},
        find=claims.pairs_per_generation,
        trials=_MANY,
    ),
    Experiment(
        name="fig-4.6-fitted",
        title="Pairs per generation, over rollouts, from the fitted start",
        question=(
            "Which N learns more from the same number of rollouts, if the start fits the size of"
            " the state?"
        ),
        claim=(
            "What matters is the number of rollouts; with a small N learning is faster (4.2.4). The"
            " thesis counts histories, which are two rollouts each."
        ),
        curves={"N 50": "contacts-D1500-N50-fitted", "N 15": "contacts-D1500-30-fitted"},
        figure=Curves(over="rollouts"),
        find=claims.rollouts_count,
        trials=_MANY,
    ),
    Experiment(
        name="equal-accuracy-fitted",
        title="State bases at equal kernel accuracy, from the fitted start",
        question=(
            "Thesis 5: how do the state bases compare if each has as many features as an accuracy"
            " of 10 % needs, and a start that fits its size?"
        ),
        curves={
            "joints, D 1600": "joints-D1600-fitted",
            "joints+contacts, D 3400": "contacts-D3400-fitted",
            "tactile, D 10800": "tactile-D10800-fitted",
            "joints+tactile, D 12600": "joints-tactile-D12600-fitted",
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
    ),
    Experiment(
        name="why-fitted",
        title="Width or initial sigma?",
        question=(
            "The fitted start changes two settings, the kernel's width (E = 2) and the initial"
            " sigma (Q = 1). Which of them makes the difference?"
        ),
        curves={
            f"{state}, {start}": f"{name}{suffix}"
            for state, name in zip(("joints+contacts", "joints+tactile"), WIDE, strict=True)
            for start, suffix in (
                ("only width", "-width"),
                ("only sigma", "-sigma"),
                ("both", "-fitted"),
            )
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
    ),
    Experiment(
        name="objects",
        title="Other objects",
        question=(
            "Thesis 5.2: can the gait be learnt with other objects, and does a policy work with"
            " objects that it was not trained on?"
        ),
        curves={name: f"object-{name}" for name in OBJECTS},
        figure=Transfer(objects=OBJECTS),
        find=claims.transfer,
    ),
    Experiment(
        name="objects-between",
        title="Other objects, with the thumb between the fingers",
        question=(
            "Can the gait be learnt with other objects within 1500 rollouts, if the thumb is"
            " between the fingers (`--pose between`) and the start fits the size of the state? Does"
            " a policy work with objects that it was not trained on?"
        ),
        curves={name: f"between-{name}-fitted" for name in OBJECTS},
        figure=Transfer(objects=OBJECTS),
        find=claims.transfer,
    ),
    Experiment(
        name="release",
        title="Taking the middle finger off",
        question=(
            "Thesis 5.2: a chain needs more gaits. Can a policy learn to take the middle finger off"
            " again (index+middle+thumb to index+thumb)? The kernel policy's actions are never"
            " negative, so it can only close the fingers; actions of direct learning have a sign."
        ),
        curves={"kernel": "release-kernel", "direct, D 100": "release-direct"},
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
    ),
    Experiment(
        name="chain",
        title="A chain of gaits",
        question=(
            "Thesis 5.2: can an upper-level policy chain learnt gaits? It switches by touch: when"
            " the sensors have shown the goal grip for three steps, the other policy takes over."
        ),
        curves={
            "add the middle finger": "default-bar",
            "take the middle finger off": "release-direct",
        },
        figure=Chain(),
        find=claims.chain,
    ),
    Experiment(
        name="friction",
        title="Friction",
        question=(
            "Thesis 5.2: real fingertips grip better than simulated ones. How does success depend"
            " on friction?"
        ),
        curves={"default": "default-bar", "thesis, D 8000": "joints-D8000"},
        figure=Friction(factors=(0.01, 0.02, 0.04, 0.07, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)),
        find=claims.friction,
    ),
    Experiment(
        name="baselines",
        title="Baselines and plain PGPE",
        question=(
            "How much do symmetric sampling and the optimal baseline help, with the same number of"
            " rollouts?"
        ),
        curves={
            "symmetric": "default-bar",
            "symmetric, optimal b": "default-optimal-baseline",
            "symmetric, b = 0": "default-no-baseline",
            "plain": "default-plain",
            "plain, optimal b": "default-plain-optimal-baseline",
        },
        figure=Curves(panels=("mean policy", "success")),
        find=claims.learning,
    ),
]

EXPERIMENTS: Final[dict[str, Experiment]] = {
    experiment.name: experiment for experiment in (*_CLAIMS, *_QUESTIONS)
}
"""By name; those of the thesis come first."""
