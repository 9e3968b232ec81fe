"""What the moves among obstacles show: figures, the table, remarks, and what they fall short of."""

from typing import Any

import numpy as np

from sim_bridge.experiments.reaching.online import PERIOD
from sim_bridge.experiments.runs import markdown_table, quantile, success_interval

SECONDS = 1.0  # processor time in which a move has to be found
RATE_WANTED = 1e6  # posture checks a second
SUCCESS_WANTED = 0.98


def solved(move: dict[str, Any]) -> bool:
    """Whether a motion was found in time, free and within the limits at every instant."""
    return move["found"] and move["seconds"] <= SECONDS and move["free"] and not move["broken"]


def offline_figures(moves: list[dict[str, Any]], compare: bool) -> dict[str, Any]:
    """What the searches found."""
    good = [move for move in moves if solved(move)]
    figures: dict[str, Any] = {
        "solved": len(good),
        "success_rate": len(good) / len(moves),
        "success_interval": list(success_interval(len(good), len(moves))),
        "offline_collisions": sum(not move["free"] for move in moves),
        "offline_limit_violations": sum(bool(move["broken"]) for move in moves),
        "failed_seeds": [move["seed"] for move in moves if not solved(move)],
        "late_seeds": [move["seed"] for move in moves if move["found"] and move["seconds"] > SECONDS],
        "evaluations_max": max(move["evaluations"] for move in moves),
        "seconds_p50": quantile([move["seconds"] for move in moves], 0.5),
        "seconds_max": max(move["seconds"] for move in moves),
        "first_valid_p50": quantile([move["first"] for move in moves], 0.5),
        "first_valid_p99": quantile([move["first"] for move in moves], 0.99),
        "straight_free": sum(move["straight_free"] for move in moves),
        "duration_p50": quantile([move["duration"] for move in good], 0.5),
        "duration_to_straight_p50": _ratio(good, "duration", "straight_duration"),
        "duration_to_bound_p50": _ratio(good, "duration", "bound"),
    }
    if compare:
        figures |= {
            "ompl_success_rate": sum(move["ompl_solved"] for move in moves) / len(moves),
            "ompl_path_rate": sum(move["ompl_path"] for move in moves) / len(moves),
            "ompl_collisions": sum(move["ompl_solved"] and not move["ompl_free"] for move in moves),
            "ompl_seconds_p50": quantile([move["ompl_seconds"] for move in moves], 0.5),
            "ompl_seconds_p99": quantile([move["ompl_seconds"] for move in moves], 0.99),
            "ompl_duration_p50": quantile([move["ompl_duration"] for move in moves], 0.5),
            "ompl_duration_to_bound_p50": _ratio(moves, "ompl_duration", "bound"),
            "ours_to_ompl_duration_p50": _ratio(good, "duration", "ompl_duration"),
            "unsolvable_for_all": [move["seed"] for move in moves if move["unsolvable"]],
        }
    return figures


def online_figures(runs: list[dict[str, Any] | None]) -> dict[str, Any]:
    """What the closed loops did; no rates if none was started."""
    done = [run for run in runs if run is not None]
    figures: dict[str, Any] = {"online_runs": len(done), "online_without_room": len(runs) - len(done)}
    if not done:
        return figures
    good = [run for run in done if run["reached"] and run["contact"] is None and not run["broken"]]
    milliseconds = np.concatenate([run["step_ms"] for run in done])
    return figures | {
        "online_blocked": sum(run["blocked"] for run in done),
        "online_success_rate": len(good) / len(done),
        "online_success_interval": list(success_interval(len(good), len(done))),
        "online_collisions": sum(run["contact"] is not None for run in done),
        "online_limit_violations": sum(bool(run["broken"]) for run in done),
        "online_failed_seeds": [run["seed"] for run in done if run not in good],
        "online_step_ms_p50": float(np.median(milliseconds)),
        "online_step_ms_p99": float(np.quantile(milliseconds, 0.99)),
        "online_step_ms_max": float(milliseconds.max()),
        "online_late_steps": float(np.mean(milliseconds > 1e3 * PERIOD)),
    }


def _ratio(moves: list[dict[str, Any]], above: str, below: str) -> float | None:
    return quantile([m[above] / m[below] for m in moves if m.get(above) and m.get(below)], 0.5)


def table(s: dict[str, Any], compare: bool) -> str:
    """Our search, OMPL, the straight move and the closed loops, one row each."""
    rows = [[
        "VP-STO", *_share(s["solved"], s["runs"]), f"{s['offline_collisions']}",
        f"{s['first_valid_p50'] or 0:.2f} / {s['seconds_p50']:.2f} s", f"{s['duration_p50'] or 0:.2f} s",
        f"{s['duration_to_bound_p50'] or 0:.2f}",
    ]]  # fmt: skip
    if compare:
        rows.append([
            "OMPL RRT-Connect, simplified", *_share(round(s["ompl_success_rate"] * s["runs"]), s["runs"]),
            f"{s['ompl_collisions']}", f"{s['ompl_seconds_p50']:.2f} s",
            f"{s['ompl_duration_p50'] or 0:.2f} s", f"{s['ompl_duration_to_bound_p50'] or 0:.2f}",
        ])  # fmt: skip
    rows.append(["straight move", *_share(s["straight_free"], s["runs"]), "-", "-", "-", "-"])
    if "online_success_rate" in s:
        good = round(s["online_success_rate"] * s["online_runs"])
        rows.append([
            "VP-STO online, a ball in the way", *_share(good, s["online_runs"]), f"{s['online_collisions']}",
            f"{s['online_step_ms_p50']:.0f} ms a step", "-", "-",
        ])  # fmt: skip
    header = ["planner", "solved", "95 % CI", "in collision", "search, first / all", "duration", "to bound"]
    return markdown_table(header, rows)


def _share(count: int, total: int) -> tuple[str, str]:
    low, high = success_interval(count, total)
    return f"{count} of {total}", f"{low:.3f}-{high:.3f}"


def remarks(s: dict[str, Any], compare: bool) -> str:
    """What does not fit into the table."""
    lines = [
        f"{s['posture_checks_per_s'] / 1e6:.2f} million free postures a second on one core, "
        f"{s['posture_checks_per_s_random'] / 1e6:.2f} million random ones "
        f"({100 * s['posture_checks_hit_share']:.0f} % hit)"
    ]
    if compare:
        lines.append(
            f"OMPL found a path for {100 * s['ompl_path_rate']:.0f} % in time, before we timed it; "
            "it asks for one state at a time in Python, while our batches are compiled"
        )
    if "online_success_rate" in s:
        lines.append(
            f"online at 20 Hz: the ball was in the way in {s['online_blocked']} of {s['online_runs']} runs; "
            f"{s['online_without_room']} scenes without room for it were left out; steps take "
            f"{s['online_step_ms_p50']:.0f} ms, p99 {s['online_step_ms_p99']:.0f} ms, "
            f"{100 * s['online_late_steps']:.1f} % longer than a period"
        )
        if s["online_failed_seeds"]:
            lines.append(f"online not at the goal unharmed: seeds {s['online_failed_seeds']}")
    if s["failed_seeds"]:
        lines.append(f"not solved: seeds {s['failed_seeds']}, of these found too late: {s['late_seeds']}")
    return "\n".join(lines)


def shortcomings(s: dict[str, Any], online: bool) -> list[str]:
    """What a summary falls short of, in words.

    Args:
        s: the summary.
        online: whether closed loops were asked for.
    """
    checks = [
        (s["success_rate"] >= SUCCESS_WANTED, f"only {100 * s['success_rate']:.1f} % solved"),
        (s["offline_collisions"] == 0, f"{s['offline_collisions']} offline in collision"),
        (s["offline_limit_violations"] == 0, f"{s['offline_limit_violations']} offline beyond limits"),
        (s["posture_checks_per_s"] >= RATE_WANTED, f"only {s['posture_checks_per_s']:.3g} checks a second"),
    ]
    if online and not s["online_runs"]:
        checks.append((False, "no closed loop could be started"))
    elif online:
        rate = s["online_success_rate"]
        checks += [
            (rate >= SUCCESS_WANTED, f"only {100 * rate:.1f} % at the goal online"),
            (s["online_collisions"] == 0, f"{s['online_collisions']} online in collision"),
            (s["online_limit_violations"] == 0, f"{s['online_limit_violations']} online beyond limits"),
        ]
    return [words for good, words in checks if not good]


def in_short(s: dict[str, Any]) -> str:
    """The figures that the verdict rests on, in one line."""
    loops = f"{100 * s['online_success_rate']:.1f} % online" if "online_success_rate" in s else "none online"
    return (
        f"{100 * s['success_rate']:.1f} % solved within {SECONDS:g} s of search (98 % wanted), {loops}, "
        f"{s['collisions']} in collision, {s['posture_checks_per_s'] / 1e6:.2f} million checks a second"
    )
