"""One view on many domains of a fleet: each domain is asked of one owner, and what the owners say is put together."""

import asyncio
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from deepsimbad.engine.atlas import Part
from deepsimbad.engine.localizer import View
from deepsimbad.engine.maps import MappedDomain
from deepsimbad.engine.session import domain_digits
from deepsimbad.errors import DeepSimbadError, UnavailableError
from deepsimbad.fleet.backend import AWAY_S, Backend, Gone
from deepsimbad.fleet.placement import N_OWNERS, owners


class AskedOwners:
    """`engine.atlas.Owners` by the replicas, as they are numbered; the second owner where the first is away."""

    def __init__(self, replicas: Sequence[Backend]) -> None:
        self._replicas = replicas

    async def gather(self, names: Sequence[str], is_all: bool) -> tuple[list[MappedDomain], dict[str, DeepSimbadError]]:
        """See `engine.atlas.Owners`."""
        there, left_out = list[MappedDomain](), dict[str, DeepSimbadError]()
        for asked, answer in await self._answers({name: name for name in names}, "gathered", is_all):
            if isinstance(answer, UnavailableError):
                left_out |= dict.fromkeys(asked, answer)
            elif isinstance(answer, DeepSimbadError):
                raise answer
            else:
                there += answer[0]
                left_out |= answer[1]
        return sorted(there, key=lambda mapped: mapped.record.name), left_out

    async def ask(
        self, domains: Sequence[MappedDomain], view: View, n_in_full: int, n_shortlist: int | None
    ) -> list[Part]:
        """See `engine.atlas.Owners`."""
        members = {mapped.record.name: mapped for mapped in domains}
        return [
            Part({}, {}, dict.fromkeys(asked, answer)) if isinstance(answer, DeepSimbadError) else answer
            for asked, answer in await self._answers(members, "part", view, n_in_full, n_shortlist)
        ]

    async def _answers(self, by_name: dict[str, Any], method: str, *arguments: Any) -> list[tuple[Sequence[str], Any]]:
        """Which domains were asked of whom, and the answer; an error of ours is one."""
        answers, missing = list[tuple[Sequence[str], Any]](), list(by_name)
        for place in range(min(N_OWNERS, len(self._replicas))):
            by_owner = defaultdict[int, list[str]](list)
            for name in missing:
                by_owner[owners(domain_digits(name), len(self._replicas))[place]].append(name)
            missing = []
            asking = (
                self._replicas[owner].ask("answer", method, [by_name[name] for name in names], *arguments)
                for owner, names in by_owner.items()
            )
            given = await asyncio.gather(*asking, return_exceptions=True)
            for names, answer in zip(by_owner.values(), given, strict=True):
                if isinstance(answer, Gone):
                    missing += names
                elif isinstance(answer, BaseException) and not isinstance(answer, DeepSimbadError):
                    raise answer
                else:
                    answers.append((names, answer))
        if missing:
            away = UnavailableError("those that know the domain are away this moment: try again", retry_after_s=AWAY_S)
            answers.append((missing, away))
        return answers
