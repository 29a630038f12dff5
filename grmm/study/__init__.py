"""``grmm study make|serve|table``: ask people which of two methods is better, as the paper did."""

from __future__ import annotations

import argparse
from pathlib import Path

from express50.console import OK, say, say_json


def add_study(commands: argparse._SubParsersAction) -> None:
    """Add the parsers of ``grmm study``."""
    parser = commands.add_parser("study", help="ask people which of two methods is better")
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    make = actions.add_parser(
        "make",
        help="choose examples and assign A and B, counterbalanced",
        epilog="example: grmm study make study --reference truth --ours grmm --theirs md",
    )
    make.add_argument("out", type=Path, help="folder for study.json and pictures/")
    make.add_argument("--reference", type=Path, required=True, help="pictures of the truth")
    make.add_argument("--ours", type=Path, required=True, help="a method's pictures, named alike")
    make.add_argument("--theirs", type=Path, required=True, help="the other method's")
    make.add_argument("--names", nargs=2, default=["Ours", "Theirs"], metavar="NAME")
    make.add_argument("--examples", type=int, default=15, help="a participant sees (15)")
    make.add_argument("--participants", type=int, default=20)
    make.add_argument("--seed", type=int, default=0)
    make.set_defaults(handler=_make)
    serve = actions.add_parser("serve", help="show the page and collect answers")
    serve.add_argument("out", type=Path)
    serve.add_argument("--host", default="127.0.0.1", help="address to listen on (this machine)")
    serve.add_argument("--port", type=int, default=8000)
    serve.set_defaults(handler=_serve)
    table = actions.add_parser("table", help="the paper's table, with confidence intervals")
    table.add_argument("out", type=Path)
    table.add_argument("--json", action="store_true", help="print the table as JSON")
    table.set_defaults(handler=_table)


def _make(args: argparse.Namespace) -> int:
    from grmm.study.design import Method, make_study

    methods = (
        Method(name=args.names[0], folder=args.ours),
        Method(name=args.names[1], folder=args.theirs),
    )
    study = make_study(
        args.out, args.reference, methods, args.examples, args.participants, args.seed
    )
    say(f"wrote {args.out / 'study.json'}: {len(study['examples'])} examples")
    return OK


def _serve(args: argparse.Namespace) -> int:
    from grmm.study.server import make_server

    with make_server(args.out, args.host, args.port) as server:
        say(f"http://{args.host}:{server.server_address[1]}  (Ctrl-C stops; answers are kept)")
        server.serve_forever()
    return OK


def _table(args: argparse.Namespace) -> int:
    from express50.files.atomic import write_bytes, write_json
    from grmm.study.results import markdown, read_answers, read_study, summarise

    study = read_study(args.out)
    summary = summarise(study, read_answers(args.out, study))
    write_json(args.out / "table.json", summary)
    write_bytes(args.out / "table.md", markdown(summary).encode())
    if args.json:
        say_json(summary)
    else:
        say(markdown(summary))
    return OK
