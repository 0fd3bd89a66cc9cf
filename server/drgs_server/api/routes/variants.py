"""REST: the material variants of a session. Each is an edit of the log that changes nothing by itself, so what is done to them is undone like others."""

from collections.abc import Callable, Sequence
from typing import Annotated

from fastapi import APIRouter, Depends, Request
from fastapi import Path as PathParameter
from pydantic import ValidationError

from drgs.scene.edits import Edit, MaterialVariant, VariantEdit
from drgs.scene.variants import kept_variants, material_edits, wearing_variant, with_renamed_variant, with_variant, without_variant
from drgs_server.api.context import ServerContext, caller_of, context_of
from drgs_server.api.door.while_connected import while_connected
from drgs_server.api.problems import ProblemError
from drgs_server.api.rest_records import VariantList, VariantNameRequest, VariantRequest
from drgs_server.live.edit_log import ChangeRequest
from drgs_server.live.messages import EditLog
from drgs_worker.store.user_names import UserName

router = APIRouter(prefix="/api/sessions/{session_id}/variants", tags=["sessions"])

Context = Annotated[ServerContext, Depends(context_of)]
VariantName = Annotated[UserName, PathParameter()]


@router.get("")
async def list_variants(session_id: str, context: Context) -> VariantList:
    """In the order in which they came."""
    kept = kept_variants((await context.sessions.get(session_id)).log.done)
    return VariantList(variants=[MaterialVariant(name=name, edits=edits) for name, edits in kept.items()])


@router.put("/{name}")
async def keep_variant(session_id: str, name: VariantName, context: Context, call: Request, body: VariantRequest | None = None) -> EditLog:
    """Keeps the material edits in force, or others, under a name; the same name is overwritten. One step of undo, as everything here."""
    given = None if body is None else body.edits

    def keep(edits: Sequence[Edit]) -> list[Edit]:
        return with_variant(edits, VariantEdit(op="variant", name=name, edits=material_edits(edits) if given is None else given))

    return await _change(session_id, context, call, keep)


@router.post("/{name}/rename")
async def rename_variant(session_id: str, name: VariantName, body: VariantNameRequest, context: Context, call: Request) -> EditLog:
    """It keeps its place."""
    return await _change(session_id, context, call, lambda edits: with_renamed_variant(edits, name, body.name))


@router.post("/{name}/apply")
async def apply_variant(session_id: str, name: VariantName, context: Context, call: Request) -> EditLog:
    """Puts its edits in the place of all material edits in force; light and shape stay."""
    return await _change(session_id, context, call, lambda edits: wearing_variant(edits, name))


@router.delete("/{name}")
async def remove_variant(session_id: str, name: VariantName, context: Context, call: Request) -> EditLog:
    """What is in force stays, even where it was this variant's."""
    return await _change(session_id, context, call, lambda edits: without_variant(edits, name))


async def _change(session_id: str, context: ServerContext, call: Request, revise: Callable[[Sequence[Edit]], list[Edit]]) -> EditLog:
    """
    Raises:
        ProblemError: no such session or variant, a name that is none or is taken, or the log has changed meanwhile.
    """
    session = await context.sessions.get(session_id)
    log = session.log
    try:
        after = revise(log.done)
    except KeyError as error:
        raise ProblemError(404, f"No variant of this session is called {error.args[0]!r}; GET .../variants lists them.") from error
    except ValidationError as error:
        raise ProblemError(422, f"{error.errors()[0]['msg']}.") from error
    except ValueError as error:
        raise ProblemError(409, f"variants: {error}.") from error
    request = ChangeRequest("restore", after, revision=log.revision)
    return (await while_connected(call, context.sessions.apply(session, request, caller_of(call, session_id)))).log
