"""Filters of event subscriptions, as the library evaluates them."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import logging
from typing import Any

import pytest

pytest.importorskip("asyncua")

from asyncua import ua
from asyncua.server.address_space import AddressSpace
from asyncua.server.monitored_item_service import WhereClauseEvaluator

from fantwin.pipeline.outputs.opcua.events import as_the_library_evaluates, condition_event, system_event
from fantwin.scoring.alarms.current_alarms import current_alarm
from tests.support.site_messages import alarm

NAMESPACE = 2
Operator = ua.FilterOperator


def element(operator: Operator, *operands: Any) -> ua.ContentFilterElement:
    return ua.ContentFilterElement(FilterOperator=operator, FilterOperands=list(operands))


def literal(value: Any) -> ua.LiteralOperand:
    return ua.LiteralOperand(Value=ua.Variant(value))


def field(*path: str) -> ua.SimpleAttributeOperand:
    return ua.SimpleAttributeOperand(
        BrowsePath=[ua.QualifiedName(part) for part in path], AttributeId=ua.AttributeIds.Value
    )


def of_type(name: str) -> ua.ContentFilterElement:
    return element(Operator.OfType, literal(ua.NodeId(getattr(ua.ObjectIds, name))))


@pytest.mark.parametrize(
    ("elements", "is_alarm_sent"),
    [
        ([], True),
        ([of_type("AlarmConditionType")], True),
        ([of_type("BaseEventType")], True),
        ([of_type("SystemEventType")], False),
        ([of_type("AuditEventType")], False),
        ([element(Operator.Equals, field("AckedState", "Id"), literal(False))], True),
        ([element(Operator.Equals, field("AckedState", "Id"), literal(True))], False),
        ([element(Operator.GreaterThan, field("Severity"), literal(950))], False),
        ([element(Operator.IsNull, field("AudibleState"))], True),
        (
            [
                element(Operator.And, ua.ElementOperand(Index=1), ua.ElementOperand(Index=2)),
                of_type("ConditionType"),
                element(Operator.Equals, field("SourceName"), literal("tray1/2")),
            ],
            True,
        ),
    ],
)
def test_a_filter_knows_subtypes_and_fields_below_others_and_lets_the_events_of_a_refresh_pass(elements, is_alarm_sent):
    clause = as_the_library_evaluates(ua.ContentFilter(Elements=elements), NAMESPACE)
    evaluator = WhereClauseEvaluator(logging.getLogger("test"), AddressSpace(), clause)
    raised = condition_event(current_alarm([alarm()]), NAMESPACE)
    assert evaluator.eval(raised) == is_alarm_sent
    assert evaluator.eval(system_event("RefreshStartEventType", "refresh begins"))
