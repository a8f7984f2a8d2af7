"""Test that hashes follow the equations of the thesis, and that a chain finds its blocks by hash."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ucp.block import Block, InceptionBlock
from ucp.chain import Chain


def sha(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def test_hashes_follow_equations_3_1_to_3_5() -> None:
    inception = InceptionBlock(b"BD0")
    assert inception.block_hash == sha(b"BD0")  # 3.3
    assert inception.chain_hash == sha(sha(b"BD0"))  # 3.4
    block = Block(agent_id=258, timestamp_us=1, event_data=b"ED")
    assert block.block_hash == sha(b"\0\0\1\2" + b"\0\0\0\0\0\0\0\1" + b"ED")  # 3.1 over 3.5
    chain = Chain(inception)
    chain.append(block)
    assert chain.top_chain_hash == sha(inception.chain_hash + block.block_hash)  # 3.2


blocks = st.integers(0, 12).map(lambda number: Block(1, number, b"x"))
steps = st.lists(st.one_of(blocks, st.none()), max_size=40)


@given(steps)
def test_chain_behaves_like_a_stack_without_duplicates(steps: list[Block | None]) -> None:
    chain = Chain(InceptionBlock(b""))
    model: list[Block] = []
    for block in steps:
        if block is None:
            if model:
                assert chain.pop() == model.pop()
            else:
                with pytest.raises(IndexError):
                    chain.pop()
        elif block in model:
            with pytest.raises(ValueError, match="already"):
                chain.append(block)
        else:
            chain.append(block)
            model.append(block)
        hashes = [chain.inception.chain_hash]
        for expected in model:
            hashes.append(sha(hashes[-1] + expected.block_hash))
        assert list(chain.with_chain_hashes()) == list(zip(model, hashes[1:], strict=True))
        assert chain.top_chain_hash == hashes[-1]
        assert chain.top_timestamp_us == (model[-1].timestamp_us if model else 0)
        for height, chain_hash in enumerate(hashes):
            assert chain.contains_chain_hash(chain_hash)
            assert chain.successor(chain_hash) == (model[height] if height < len(model) else None)
        for number in range(13):
            candidate = Block(1, number, b"x")
            assert (candidate.block_hash in chain) == (candidate in model)
            assert chain.get(candidate.block_hash) == (candidate if candidate in model else None)
