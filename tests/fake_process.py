"""An implementation behind the process interface that shares no code with the kit and misbehaves as its argument says.

It knows symlog, refuses what is not finite, and holds every message in both directions against the schema of the
protocol.
"""

import base64
import json
import math
import os
import struct
import sys
import time
from pathlib import Path

import jsonschema

SCHEMA = json.loads(
    (Path(__file__).resolve().parent.parent / "conformance" / "protocol.schema.json").read_text(encoding="utf-8")
)
VALIDATORS = {
    name: jsonschema.Draft202012Validator({"$ref": f"#/$defs/{name}", "$defs": SCHEMA["$defs"]})
    for name in ("request", "start_reply", "edition_reply", "run_reply", "stop_reply", "error_reply")
}
FORMATS = {"float64": "d", "float32": "f", "int64": "q", "int32": "i", "uint8": "B", "bool": "?"}


def numbers(array):
    raw = base64.b64decode(array["data"])
    return struct.unpack(f"<{math.prod(array['shape'])}{FORMATS[array['dtype']]}", raw)


def array_of(values, shape):
    raw = struct.pack(f"<{len(values)}d", *values)
    return {"dtype": "float64", "shape": shape, "data": base64.b64encode(raw).decode()}


def symlog(x):
    values = numbers(x) if isinstance(x, dict) else [x]
    signed = [math.copysign(math.log1p(abs(value)), value) if value == value else value for value in values]
    return array_of(signed, x["shape"] if isinstance(x, dict) else [])


def result_of(request):
    if request["method"] == "start":
        functions = (
            [f"f{n}" for n in range(1_000_000)]
            if MODE == "a million functions"
            else ["symlog", "kl_losses", "an_extra"]
        )
        name = "fake" * 10**6 if MODE == "long name" else "fake"
        return {"protocol": 1, "name": name, "version": "0.1", "functions": functions}
    if request["method"] == "edition":
        return 3 if MODE == "odd edition" else "official"
    if request["method"] == "run":
        if request["function"] == "kl_losses":  # what came, as it came
            return {"map": {"dynamics": request["args"][0], "representation": request["args"][1]}}
        return symlog(*request["args"])
    return None


def reply_to(request):
    reply = {"id": request["id"], "result": result_of(request)}
    if (MODE in ERRORS and request["method"] == "run") or f"refuses {request['method']}" == MODE:
        reply = {"id": request["id"], "error": {"kind": MODE, "message": "fake refuses x"}}
    if MODE in ("odd edition", "a million functions"):
        return json.dumps(reply)
    VALIDATORS["error_reply" if "error" in reply else f"{request['method']}_reply"].validate(reply)
    return json.dumps(reply)


def write(text):
    sys.stdout.write(text)
    sys.stdout.flush()


def misbehave(reply):
    """In place of a reply to `run`."""
    if MODE == "crash":
        sys.stderr.write("the first line\nSegmentation of reality\n")
        sys.exit(3)
    if MODE == "hang":
        time.sleep(600)
    if MODE == "half line":
        write(reply[: len(reply) // 2])
        sys.exit(0)
    if MODE == "half line and hang":
        write(reply[: len(reply) // 2])
        time.sleep(600)
    if MODE == "deep and hang":
        write("[" * 100_000 + "\n")
        time.sleep(600)
    if MODE == "close":
        os.close(1)
        time.sleep(600)
    write(
        {
            "unexpected output": "loading weights...\n42\n" + '{"level": "info"}\n' + reply,
            "endless unexpected output": "nothing\n" * 1000,
            "wrong id": '{"id": 7777, "result": null}',
            "neither": reply.replace('"result"', '"answer"'),
            "error without a message": reply.partition(",")[0] + ', "error": {"kind": "ValueError"}}',
            "huge line": "x" * 3_000_000,
            "too few bytes": reply.replace('"shape": [', '"shape": [7, '),
            "unknown dtype": reply.replace("float64", "float8"),
            "text": reply.partition(",")[0] + ', "result": "fine"}',
            "a list as kind": reply.partition(",")[0] + ', "error": {"kind": ["ValueError"], "message": "x"}}',
            "long error": reply.partition(",")[0]
            + f', "error": {{"kind": "{"k" * LONG}", "message": "{"x" * LONG}"}}}}',
            "long refusal": reply.partition(",")[0]
            + f', "error": {{"kind": "ValueError", "message": "{"x" * LONG}"}}}}',
            "many values": reply.partition(",")[0] + f', "result": [{"[]," * 300_000}[]]}}',
            "huge number": reply.partition(",")[0] + f', "result": {10**40}}}',
            "impossible shape": reply.partition(",")[0]
            + f', "result": {{"dtype": "float64", "shape": [0, {10**30}], "data": ""}}}}',
            "null": reply.partition(",")[0] + ', "result": null}',
        }.get(MODE, reply)
        + "\n"
    )


ERRORS = ("ValueError", "KeyError", "TypeError")
MODE = sys.argv[1] if len(sys.argv) > 1 else ""
LONG = 10_000_000 if MODE.startswith("long ") else 1


def main():
    if MODE == "dies at once":
        sys.exit("no such licence")
    if MODE == "reads nothing":
        time.sleep(600)
    for line in sys.stdin:
        request = json.loads(line)
        VALIDATORS["request"].validate(request)
        reply = reply_to(request)
        if request["method"] == "run":
            misbehave(reply)
        elif MODE == "old protocol" and request["method"] == "start":
            write(reply.replace('"protocol": 1', '"protocol": 0') + "\n")
        elif MODE == "does not stop" and request["method"] == "stop":
            time.sleep(600)
        else:
            write(reply + "\n")
        if request["method"] == "run" and MODE == "stops reading":
            time.sleep(600)
        while request["method"] == "start" and MODE == "flood":
            write("nothing\n" * 10_000)
        if request["method"] == "stop":
            return


if __name__ == "__main__":
    main()
