"""The standard nodes of OPC UA, loaded once per process: every simulated control has them, and they take half a second.

Each server gets nodes of its own with the same values, as the library's own loading would make them.
"""

from pathlib import Path

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
            server.aspace._nodes.update(copied(kept))
            return
        await load(server, shelf_file)
        kept.update(copied(server.aspace._nodes))

    InternalServer.load_standard_address_space = load_or_copy  # type: ignore[method-assign]


def copied(nodes: Nodes) -> Nodes:
    found = {}
    for node_id, node in nodes.items():
        found[node_id] = copy = NodeData(node_id)
        copy.attributes = {name: AttributeValue(attribute.value) for name, attribute in node.attributes.items()}
        copy.references, copy.call = list(node.references), node.call
    return found
