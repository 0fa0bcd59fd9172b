"""What hosts of one training answer, and which may train together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from pronk.errors import PronkError
from pronk.jump.train.hosts import Host, HostFacts, HostQuestion, check_answers, parse_hosts

QUESTION = HostQuestion(
    robot="mini_cheetah",
    device="auto",
    gpu_ids="all",
    mark="/shared/runs/mark",
    launcher="desk.example",
    port=4000,
)
FACTS = HostFacts(
    host_name="desk.example",
    gpus=("0", "1"),
    gpu_uuids=("a", "b"),
    device={"device": "cuda", "name": "card", "count": 2},
    versions={"pronk": "1", "torch": "2"},
    sources_sha256="sources",
    robot_sha256="robot",
    boot_id="boot",
    address="10.0.0.1",
    shares_folder=True,
)
NODE = replace(
    FACTS, host_name="node", gpu_uuids=("c", "d"), boot_id="other boot", address="10.0.0.2"
)


def hosts(facts: HostFacts) -> list[Host]:
    """Two hosts, the second with these facts."""
    return [Host(name="desk", facts=FACTS), Host(name="node", facts=facts)]


def test_hosts_that_are_alike_train_together() -> None:
    check_answers(hosts(NODE), FACTS, QUESTION)
    assert [host.processes for host in hosts(NODE)] == [2, 2]
    assert Host(name="node", facts=replace(NODE, gpus=())).processes == 1
    # A newer machine may have other cores or another card; its numbers are the same.
    check_answers(hosts(replace(NODE, device={"device": "cuda", "name": "new"})), FACTS, QUESTION)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"error": "no GPU was found"}, "node|no GPU"),
        ({"versions": {"pronk": "1", "torch": "3"}}, "node|torch 3|2"),
        ({"versions": {"pronk": "1"}}, "node|torch"),
        ({"sources_sha256": "x"}, "node|sources"),
        ({"robot_sha256": "x"}, "node|mini_cheetah"),
        ({"shares_folder": False}, "node|/shared/runs|--out"),
        ({"connection_error": "timed out"}, "node|desk.example|timed out"),
        ({"address": "127.0.1.1"}, "node|127.0.1.1|GLOO_SOCKET_IFNAME"),
        ({"gpus": ("0", "1", "2")}, "desk|GPU 0, 1|node|GPU 0, 1, 2|--gpu-ids"),
        ({"gpus": (), "gpu_uuids": ()}, "node|CPU|--device cpu"),
        ({"gpu_uuids": ("c", "b")}, "desk|node|one machine"),
    ],
)
def test_hosts_that_differ_are_refused(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], words: str
) -> None:
    monkeypatch.delenv("GLOO_SOCKET_IFNAME", raising=False)
    with pytest.raises(PronkError) as refusal:
        check_answers(hosts(replace(NODE, **changes)), FACTS, QUESTION)
    for word in words.split("|"):
        assert word in str(refusal.value)


def test_a_loopback_name_does_where_the_network_device_is_named_or_the_machine_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loopback = replace(NODE, address="127.0.1.1")
    monkeypatch.setenv("GLOO_SOCKET_IFNAME", "eth0")
    check_answers(hosts(loopback), FACTS, QUESTION)
    monkeypatch.delenv("GLOO_SOCKET_IFNAME")
    check_answers(hosts(replace(loopback, boot_id=FACTS.boot_id)), FACTS, QUESTION)


def test_names_are_read() -> None:
    assert parse_hosts("node1, node-2.example,10.0.0.3,fd00::1") == (
        "node1",
        "node-2.example",
        "10.0.0.3",
        "fd00::1",
    )
