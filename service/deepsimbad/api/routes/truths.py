"""Telling a session where its robot truly was: how good the live answers are."""

import math

from anyio.to_thread import run_sync
from fastapi import APIRouter, Request

from deepsimbad.api.bodies import declare_json, read_json
from deepsimbad.api.dependencies import Running, SessionId
from deepsimbad.api.openapi import problems
from deepsimbad.api.session_bodies import TruthsBody
from deepsimbad.api.session_schemas import TruthsAnswer

router = APIRouter(prefix="/v1", tags=["sessions"])


@router.post(
    "/sessions/{session_id}/truths",
    responses=problems(404, 410, 413, 415, 422),
    openapi_extra=declare_json(TruthsBody),
)
async def post_truths(session_id: SessionId, request: Request, running: Running) -> TruthsAnswer:
    """Rank the truth in the belief as it was after every observation.

    The session may have ended, up to a day ago unless the settings say otherwise. The answer's ANR is that of this
    session; the metric `deepsimbad_live_anr_percent` counts every observation once, whoever tells of it how often. The
    positions are kept, so that a map can learn from them.
    """
    body = await read_json(request, TruthsBody)
    ranked, before_m = await running.truths.keep(
        session_id, body.true_positions_m, body.true_map_images, body.first_observation
    )
    await run_sync(running.metrics.fed_back, ranked.domain, ranked.new_since(before_m).tolist())
    ranks = ranked.retrieval_rank
    return TruthsAnswer(
        n_scored=ranked.n_scored,
        n_left_out=ranked.n_left_out,
        anr=ranked.anr,
        retrieval_ranks=None if ranks is None else [None if math.isnan(one) else one for one in ranks[ranked.first :]],
        map_version=ranked.map_version,
    )
