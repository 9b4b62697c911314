"""``illumgrid verify``: closed forms against backends."""

from typing import Annotated

import typer


def verify(
    backends: Annotated[
        list[str] | None,
        typer.Option("--backend", metavar="NAME", help="Backend to check (repeatable). [default: all]"),
    ] = None,
    paths: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Light paths per scene, divided among its queries; fewer for reference."),
    ] = 1 << 18,
    seed: Annotated[
        int,
        typer.Option(
            min=0, max=2**64 - 1, metavar="N", help="Seed of the random numbers; equal seeds give equal paths."
        ),
    ] = 0,
) -> None:
    """Compare the backends with scenes whose light has a closed form; exit 1 if one disagrees.

    z is the mean difference over the queries, divided by its standard error and a derived bound on the error of the
    discretised surface; max |z| is the largest of a single query.
    """
    from illumgrid.accuracy.verify import check, contenders
    from illumgrid.transport.agreement import HEADER, line

    rows, found = [], check(contenders(backends or ()), paths, seed)  # refuses before anything is printed
    typer.echo(HEADER)
    for row in found:
        typer.echo(line(row))
        rows.append(row)
    wrong = sum(not row.agrees for row in rows)
    typer.echo(f"{len(rows) - wrong} of {len(rows)} agree")
    if wrong:
        raise typer.Exit(1)
