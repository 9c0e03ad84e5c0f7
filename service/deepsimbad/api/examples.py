"""Examples in the OpenAPI document: what a first request may look like."""

from collections.abc import Mapping
from typing import Any

BODIES: Mapping[str, Any] = {
    "DomainBody": {"evaluator": {"kind": "feature_l2"}, "closed": False},
    "TraverseBody": {"name": "2012-08-20"},
    "RemapBody": {"training_traverse": "2012-08-20", "landmark_traverse": "2012-05-11", "gate_margin": 2.0},
    "ActiveMapBody": {"version": 1, "expected": 2},
    "SessionBody": {"start_position_m": 4.5, "start_std_m": 10.0},
    "PriorBody": {"position_m": 8.0, "std_m": 3.0},
    "TruthsBody": {"true_positions_m": [4.5, 7.5, None]},
    "ExperienceBody": {"session_id": "5f0c2f7e8a7b4a0c9d3e1b2a4c6d8e0f", "true_positions_m": [4.5, 7.5, None]},
}
PARAMETERS: Mapping[str, Any] = {
    "domain": "campus",
    "name": "2012-08-20",
    "session_id": "5f0c2f7e8a7b4a0c9d3e1b2a4c6d8e0f",
    "job_id": "8a7b4a0c9d3e1b2a4c6d8e0f5f0c2f7e",
    "version": 1,
    "index": 0,
    "position_m": 12.5,
    "timestamp_us": 1_345_480_000_000_000,
    "x_m": 101.5,
    "y_m": -42.25,
    "action_m": 3.0,
    "action_std_m": 0.3,
    "shortlist": 10,
    "limit": 100,
    "Idempotency-Key": "robot-7/421",
    "If-Match": "*",
    "map_version": 1,
}
ENCODED_ON_BOARD = {"ranked_landmarks": [7, 2, 9, 0]}


def write_examples(operations: Mapping[str, dict[str, Any]], schemas: dict[str, Any]) -> None:
    """Put the examples where readers of the document look for them.

    Args:
        operations: Every operation, changed in place.
        schemas: The document's schemas by name, changed in place.
    """
    for name, example in BODIES.items():
        schemas[name]["examples"] = [example]
    for operation in operations.values():
        for parameter in operation.get("parameters", ()):
            if parameter["name"] in PARAMETERS:
                parameter["example"] = PARAMETERS[parameter["name"]]
        for content in operation.get("requestBody", {}).get("content", {}).values():
            if "oneOf" in content["schema"]:  # what a robot that encodes on board may send
                content["example"] = ENCODED_ON_BOARD
