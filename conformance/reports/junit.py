"""The result as JUnit XML, which CI services show: a test suite for each chapter, a test case for each
check."""

import re
from xml.etree import ElementTree

from conformance.reports import summary
from conformance.reports.summary import Data

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def render(data: Data) -> str:
    """Expected failures are skipped, and what is not judged. What else stands against the run is a failure in the suite
    `verdict`."""
    suites = ElementTree.Element("testsuites", name=_text(f"conformance of {summary.label(data)}"))
    by_chapter: dict[str, list[ElementTree.Element]] = {}
    for name, check in data["checks"].items():
        chapter, _, title = name.partition(".")
        by_chapter.setdefault(chapter, []).append(_case(data, chapter, title, check))
    by_chapter["verdict"] = [_verdict(data)]
    for chapter, cases in by_chapter.items():
        kinds = {
            kind: str(sum(case.find(kind) is not None for case in cases)) for kind in ("failure", "error", "skipped")
        }
        counts = {
            "tests": str(len(cases)),
            "failures": kinds["failure"],
            "errors": kinds["error"],
            "skipped": kinds["skipped"],
        }
        suite = ElementTree.SubElement(suites, "testsuite", {"name": _text(chapter), **counts})
        _properties(suite, data)
        suite.extend(cases)
    ElementTree.indent(suites)
    return ElementTree.tostring(suites, encoding="unicode", xml_declaration=True) + "\n"


def _text(plain: str) -> str:
    """Without the characters that XML cannot hold."""
    return _FORBIDDEN.sub("\N{REPLACEMENT CHARACTER}", plain)


def _properties(suite: ElementTree.Element, data: Data) -> None:
    properties = ElementTree.SubElement(suite, "properties")
    for name in ("candidate", "dtype", "edition", "seed", "examples"):
        ElementTree.SubElement(properties, "property", name=name, value=_text(str(data[name])))
    for name, version in data["versions"].items():
        ElementTree.SubElement(properties, "property", name=_text(f"version of {name}"), value=_text(version))


def _case(data: Data, chapter: str, title: str, check: Data) -> ElementTree.Element:
    case = ElementTree.Element("testcase", classname=_text(f"conformance.{chapter}"), name=_text(title))
    message = _text(check["message"].strip())
    first = message.splitlines()[-1] if check["status"] == "error" and message else message.partition("\n")[0]
    if check["status"] in ("not offered", "not in edition"):
        ElementTree.SubElement(case, "skipped", message=message)
    elif summary.is_expected(check):
        ElementTree.SubElement(case, "skipped", message=_text(f"expected failure: {check['expected_failure']}"))
    elif check["status"] in summary.FAILING:
        kind = "failure" if check["status"] == "fail" else "error"
        failed = ElementTree.SubElement(case, kind, message=first, type=", ".join(map(_text, check["requirements"])))
        failed.text = _text(_details(data, f"{chapter}.{title}", check))
    return case


def _details(data: Data, name: str, check: Data) -> str:
    failure = check["failure"]
    values = [f"{value['name']}: {value['type']}\n{value['text']}" for value in summary.values(failure)]
    diagnoses = [
        f"{summary.introduction(found)}: {found['explanation']}. {found['fix']}"
        for found in summary.matching(data, name)
    ]
    return "\n\n".join(
        [
            "",
            check["summary"],
            check["message"].strip(),
            *diagnoses,
            *values,
            failure["command"],
            failure["snippet"],
            "",
        ]
    )


def _verdict(data: Data) -> ElementTree.Element:
    case = ElementTree.Element("testcase", classname="conformance.verdict", name="verdict")
    if not data["verdict"]["passed"]:
        problems = [_text(problem) for problem in data["verdict"]["problems"]]
        ElementTree.SubElement(case, "failure", message="; ".join(problems)).text = "\n".join(problems)
    return case
