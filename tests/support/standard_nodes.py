"""The standard nodes of OPC UA, loaded once per process: every simulated control has them, and they take half a second.

Each server gets nodes of its own with the same values, as the library's own loading would make them.
"""

from pathlib import Path
from typing import Any

from asyncua import ua
from asyncua.server.address_space import AttributeValue, NodeData
from asyncua.server.internal_server import InternalServer

Nodes = dict[ua.NodeId, NodeData]


def loaded_once() -> None:
    """Let every server after the first one in this process get copies of what the first one has loaded."""
    load = InternalServer.load_standard_address_space
    kept: Nodes = {}

    async def load_or_copy(server: InternalServer, shelf_file: Path | None = None) -> None:
        if kept:
            server.aspace._nodes = Copies(kept)
            return
        await load(server, shelf_file)
        kept.update({node_id: copied(node) for node_id, node in server.aspace._nodes.items()})

    InternalServer.load_standard_address_space = load_or_copy  # type: ignore[method-assign]


class Copies(Nodes):
    """Nodes that are copied when a server asks for them first: a client comes to few of the thousands."""

    def __init__(self, kept: Nodes) -> None:
        super().__init__(kept)
        self.kept = kept

    def __getitem__(self, node_id: ua.NodeId) -> NodeData:
        node = super().__getitem__(node_id)
        if node is self.kept.get(node_id):
            self[node_id] = node = copied(node)
        return node

    def get(self, node_id: ua.NodeId, default: Any = None) -> Any:
        try:
            return self[node_id]
        except KeyError:
            return default

    def items(self) -> Any:
        return {node_id: self[node_id] for node_id in self}.items()

    def values(self) -> Any:
        return [self[node_id] for node_id in self]


def copied(node: NodeData) -> NodeData:
    copy = NodeData(node.nodeid)
    copy.attributes = {name: AttributeValue(attribute.value) for name, attribute in node.attributes.items()}
    copy.references, copy.call = list(node.references), node.call
    return copy
