"""The description of the API for machines (OpenAPI 3.1), made of the paths and the forms."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from pydantic.json_schema import models_json_schema

from fantwin.pipeline.outputs.web.access import CSRF_HEADER
from fantwin.pipeline.outputs.web.forms import LoginForm
from fantwin.pipeline.site.fan_groups import FanGroup
from fantwin.pipeline.site.request_form import RequestForm

_FORMS = {"/login": LoginForm, "/fans/{tray}/{fan}/requests": RequestForm}
_QUERY: Mapping[str, Mapping[str, str | list[str]]] = {
    "/fans": {"tray": "string", "state": list(FanGroup), "limit": "integer"},
    "/fans/{tray}/{fan}/curves": {"seconds": "integer"},
    "/alarms": {"all": "integer"},
    "/alarms/history": {"tray": "string", "fan": "integer", "limit": "integer", "before": "integer"},
    "/clips": {"tray": "string"},
    "/events": {"fan": "string"},
}
"""by path, the parameters with their type, or the words that they may be"""
_KINDS = {"/events": "text/event-stream", "/clips/{name}": "application/octet-stream"}
_ERRORS = {"401": "nobody is logged in", "403": "the user may not do this", "404": "no such tray or fan"}
_OF_LIST = {"422": "a parameter is wrong"}
_OF_REQUEST = {"409": "the scorer has refused it", "422": "the form is wrong", "504": "no scorer has answered"}


def description(prefix: str, paths: Mapping[str, tuple[str, Callable[..., object]]]) -> dict[str, Any]:
    """The document; paths: method and handler of each, whose docstring describes it."""
    _, definitions = models_json_schema(
        [(form, "validation") for form in _FORMS.values()], ref_template="#/components/schemas/{model}"
    )
    return {
        "openapi": "3.1.0",
        "info": {"title": "fantwin gateway", "version": "1"},
        "paths": {
            f"{prefix}{path}": {method.lower(): _operation(path, method, handler)}
            for path, (method, handler) in paths.items()
        },
        "components": {
            "schemas": definitions["$defs"],
            "securitySchemes": {
                "session": {"type": "apiKey", "in": "cookie", "name": "fantwin"},
                "token": {"type": "apiKey", "in": "header", "name": CSRF_HEADER},
            },
        },
    }


def _schema(kind: str | list[str]) -> dict[str, Any]:
    return {"type": kind} if isinstance(kind, str) else {"type": "string", "enum": kind}


def _operation(path: str, method: str, handler: Callable[..., object]) -> dict[str, Any]:
    named = [
        {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
        for name in re.findall(r"{(\w+)}", path)
    ]
    asked = [
        {"name": name, "in": "query", "required": False, "schema": _schema(kind)}
        for name, kind in _QUERY.get(path, {}).items()
    ]
    kind = _KINDS.get(path, "application/json")
    errors = _ERRORS | (_OF_REQUEST if method == "POST" else _OF_LIST if path in _QUERY else {})
    operation: dict[str, Any] = {
        "operationId": getattr(handler, "__name__", ""),
        "summary": " ".join((handler.__doc__ or "").split()),
        "parameters": named + asked,
        "responses": {"200": {"description": "done", "content": {kind: {}}}}
        | {code: {"description": why} for code, why in errors.items()},
    }
    if path in _FORMS:
        content = {"application/json": {"schema": {"$ref": f"#/components/schemas/{_FORMS[path].__name__}"}}}
        operation["requestBody"] = {"required": True, "content": content}
        operation["security"] = [{"session": [], "token": []}] if path != "/login" else []
    return operation
