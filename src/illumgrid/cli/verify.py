"""``illumgrid verify``: closed forms against backends."""

from typing import Annotated

import typer


def verify(
    backends: Annotated[
        list[str] | None,
        typer.Option("--backend", metavar="NAME", help="Backend, repeatable. [default: all there are]"),
    ] = None,
    paths: Annotated[
        int, typer.Option(min=1, metavar="N", help="Light paths a scene, shared by its queries; reference takes fewer.")
    ] = 1 << 18,
    seed: Annotated[int, typer.Option(min=0, max=2**64 - 1, metavar="N", help="Equal seeds give equal paths.")] = 0,
) -> None:
    """Judge the backends by scenes whose light has a closed form; exit 1 if one disagrees.

    z is the mean difference over the queries in units of its standard error and of a derived bound on what the cells of
    the surface do; max |z| is that of a single query.
    """
    from illumgrid.accuracy.verify import HEADER, check, line

    typer.echo(HEADER)
    rows = []
    for row in check(backends or None, paths, seed):
        typer.echo(line(row))
        rows.append(row)
    wrong = sum(not row.agrees for row in rows)
    typer.echo(f"{len(rows) - wrong} of {len(rows)} agree")
    if wrong:
        raise typer.Exit(1)
