-- UCP in Wireshark and tshark: the header, nine messages, blocks and their events, on UDP port 14600. Of a secured
-- mission, version 3, it shows the clear header. `ucp-harness packets --bundle` opens the sealed part.
--
--     wireshark -X lua_script:ucp.lua capture.pcapng
--
-- Every datagram on the port is taken for UCP. One that is not exactly one well-formed message is marked, with the
-- reason that an agent would give for refusing it, as `ucpchain.malformed`. The fields are those that
-- ucp/messages.py, ucp/block.py and ucp/events.py declare; tests compare them. Filters begin with `ucpchain`, because
-- Wireshark has another protocol `ucp`, the Universal Computer Protocol.

local ucp = Proto("ucpchain", "Uniform Chain Protocol")

local PORT = 14600
local MAGIC = "UC"
local VERSION = 1
local HEADER_BYTES = 14
local SECURED_VERSION = 3
local CLEAR_BYTES = 36
local BOOT_BYTES = 16
local TAG_BYTES = 16
local SIGNATURE_BYTES = 64
local REVOCATION = 10
local ECHO = 12
local MAX_DATAGRAM_BYTES = 1472
local HASH_BYTES = 32
local BLOCK_HEADER_BYTES = 12
local MAX_EVENT_DATA_BYTES = 1024
local EVENT_HEADER_BYTES = 11
local MAX_AGENT_ID = 65535
local MAX_EVENT_ID = 254

local NAMES = {
  [1] = "Block Add Request",
  [2] = "Block Add Response",
  [3] = "Commit Block",
  [4] = "Chain Contain Query",
  [5] = "Chain Contain Response",
  [6] = "Chain Hash Successor Query",
  [7] = "Next in Sequence Response",
  [8] = "Request for Block",
  [9] = "Block Response",
  [10] = "Revocation",
  [11] = "Challenge",
  [12] = "Echo",
}

local fields = {
  magic = ProtoField.string("ucpchain.magic", "Magic"),
  version = ProtoField.uint8("ucpchain.version", "Version"),
  type = ProtoField.uint8("ucpchain.type", "Type", base.DEC, NAMES),
  sender = ProtoField.uint32("ucpchain.sender", "Sender"),
  sequence = ProtoField.uint32("ucpchain.sequence", "Sequence"),
  length = ProtoField.uint16("ucpchain.length", "Body length"),
  approve = ProtoField.uint8("ucpchain.approve", "Approve", base.DEC, { [0] = "no", [1] = "yes" }),
  contained = ProtoField.uint8("ucpchain.contained", "Contained", base.DEC, { [0] = "no", [1] = "yes" }),
  block_hash = ProtoField.bytes("ucpchain.block_hash", "Block hash"),
  chain_hash = ProtoField.bytes("ucpchain.chain_hash", "Chain hash"),
  timestamp_us = ProtoField.uint64("ucpchain.timestamp_us", "Timestamp (us)"),
  is_top_of_chain = ProtoField.bool("ucpchain.is_top_of_chain", "Is Top Of Chain"),
  block = ProtoField.none("ucpchain.block", "Block"),
  block_agent_id = ProtoField.uint32("ucpchain.block.agent_id", "Agent ID"),
  block_timestamp_us = ProtoField.uint64("ucpchain.block.timestamp_us", "Timestamp (us)"),
  event = ProtoField.none("ucpchain.event", "Loggable Event"),
  event_timestamp_us = ProtoField.uint64("ucpchain.event.timestamp_us", "Timestamp (us)"),
  event_id = ProtoField.uint8("ucpchain.event.event_id", "Event ID"),
  event_length = ProtoField.uint16("ucpchain.event.length", "Length"),
  event_data = ProtoField.bytes("ucpchain.event.data", "Data"),
  epoch = ProtoField.uint32("ucpchain.epoch", "Epoch"),
  boot = ProtoField.bytes("ucpchain.boot", "Boot"),
  revocations = ProtoField.uint16("ucpchain.revocations", "Digest of the known revocations"),
  ciphertext = ProtoField.bytes("ucpchain.ciphertext", "Ciphertext"),
  tag = ProtoField.bytes("ucpchain.tag", "Tag"),
}
ucp.fields = fields

local malformed = ProtoExpert.new("ucpchain.malformed", "Malformed", expert.group.MALFORMED, expert.severity.ERROR)
local no_event = ProtoExpert.new("ucpchain.event.malformed", "No event", expert.group.MALFORMED, expert.severity.WARN)
local cut_off = ProtoExpert.new("ucpchain.cut_off", "Not captured whole", expert.group.UNDECODED, expert.severity.WARN)
ucp.experts = { malformed, no_event, cut_off }

-- Where reading has got to: the bytes of `tvb` from `at` up to `stop` are still to be read, and are shown in `tree`.

local Reader = {}
Reader.__index = Reader

function Reader:left()
  return self.stop - self.at
end

function Reader:add(field, count)
  local bytes = self.tvb(self.at, count)
  self.at = self.at + count
  return self.tree:add(field, bytes), bytes
end

function Reader:inside(tree)
  return setmetatable({ tvb = self.tvb, at = self.at, stop = self.stop, tree = tree }, Reader)
end

-- Kinds of fields. Each reads one, and returns the reason if that makes the message malformed.

local function hash(reader, field)
  if reader:left() < HASH_BYTES then
    return "wrong length"
  end
  reader:add(field, HASH_BYTES)
end

local function optional_hash(reader, field)
  if reader:left() > 0 then
    return hash(reader, field)
  end
end

local function successor(reader, field)
  if reader:left() == 0 then
    reader.tree:add(fields.is_top_of_chain, true):set_generated()
  end
  return optional_hash(reader, field)
end

local function flag(reader, field)
  if reader:left() < 1 then
    return "bad vote"
  end
  local _, byte = reader:add(field, 1)
  if byte:uint() > 1 then
    return "bad vote"
  end
end

local function timestamp(reader, field)
  if reader:left() < 8 then
    return "wrong length"
  end
  reader:add(field, 8)
end

local function event(reader)
  if reader:left() < EVENT_HEADER_BYTES then
    return "the event's header is cut off"
  end
  local id, length = reader.tvb(reader.at + 8, 1):uint(), reader.tvb(reader.at + 9, 2):uint()
  if EVENT_HEADER_BYTES + length > reader:left() then
    return "the event claims " .. length .. " bytes, more than are left"
  end
  if id < 1 or id > MAX_EVENT_ID then
    return "the event has ID " .. id .. ", not in 1.." .. MAX_EVENT_ID
  end
  local inside = reader:inside(reader.tree)
  inside.tree = reader:add(fields.event, EVENT_HEADER_BYTES + length)
  inside.tree:append_text(" " .. id .. ", " .. length .. " bytes")
  inside:add(fields.event_timestamp_us, 8)
  inside:add(fields.event_id, 1)
  inside:add(fields.event_length, 2)
  if length > 0 then
    inside:add(fields.event_data, length)
  end
end

local function block(reader, field)
  local size = reader:left()
  if size <= BLOCK_HEADER_BYTES or size > BLOCK_HEADER_BYTES + MAX_EVENT_DATA_BYTES then
    return "wrong length"
  end
  local inside = reader:inside(reader.tree)
  inside.tree = reader:add(field, size)
  local _, agent_id = inside:add(fields.block_agent_id, 4)
  inside:add(fields.block_timestamp_us, 8)
  inside.tree:append_text(" of agent " .. agent_id:uint())
  if agent_id:uint() < 1 or agent_id:uint() > MAX_AGENT_ID then
    return "impossible agent"
  end
  while inside:left() > 0 do
    local wrong = event(inside)
    if wrong then
      inside.tree:add_proto_expert_info(no_event, "At byte " .. inside.at .. " " .. wrong)
      return
    end
  end
end

local BODIES = {
  [1] = { { hash, fields.block_hash }, { hash, fields.chain_hash } },
  [2] = { { flag, fields.approve }, { hash, fields.block_hash }, { optional_hash, fields.chain_hash } },
  [3] = { { hash, fields.chain_hash }, { block, fields.block } },
  [4] = { { hash, fields.chain_hash } },
  [5] = { { flag, fields.contained }, { hash, fields.chain_hash } },
  [6] = { { hash, fields.chain_hash } },
  [7] = { { timestamp, fields.timestamp_us }, { hash, fields.chain_hash }, { successor, fields.block_hash } },
  [8] = { { hash, fields.block_hash } },
  [9] = { { block, fields.block } },
}

local function header(reader, info)
  local size = reader.tvb:reported_len()
  info.header_bytes = HEADER_BYTES
  if size < HEADER_BYTES then
    return "truncated"
  end
  if size > MAX_DATAGRAM_BYTES then
    return "oversized"
  end
  local _, magic = reader:add(fields.magic, #MAGIC)
  if magic:raw() ~= MAGIC then
    return "wrong magic"
  end
  local _, version = reader:add(fields.version, 1)
  info.secured = version:uint() == SECURED_VERSION
  if info.secured then
    info.header_bytes = CLEAR_BYTES
    if size < CLEAR_BYTES then
      return "truncated"
    end
  elseif version:uint() ~= VERSION then
    return "wrong version"
  end
  local _, code = reader:add(fields.type, 1)
  local _, sender = reader:add(fields.sender, 4)
  reader:add(fields.sequence, 4)
  local _, length = reader:add(fields.length, 2)
  if info.secured then
    reader:add(fields.epoch, 4)
    reader:add(fields.boot, BOOT_BYTES)
    reader:add(fields.revocations, 2)
  end
  info.name, info.sender, info.code = NAMES[code:uint()] or "Unknown type", sender:uint(), code:uint()
  if info.sender < 1 or info.sender > MAX_AGENT_ID then
    return "impossible sender"
  end
  if length:uint() ~= size - info.header_bytes then
    return "wrong length"
  end
  if not BODIES[info.code] and not (info.secured and info.code >= REVOCATION and info.code <= ECHO) then
    return "unknown type"
  end
end

local function sealed(reader, info)
  local least = info.code == REVOCATION and TAG_BYTES or TAG_BYTES + SIGNATURE_BYTES
  if reader:left() < least then
    return "wrong length"
  end
  if reader:left() > TAG_BYTES then
    reader:add(fields.ciphertext, reader:left() - TAG_BYTES)
  end
  reader:add(fields.tag, TAG_BYTES)
end

local function body(reader, info)
  if info.secured then
    return sealed(reader, info)
  end
  for _, part in ipairs(BODIES[info.code]) do
    local read, field = part[1], part[2]
    local reason = read(reader, field)
    if reason then
      return reason
    end
  end
  if reader:left() > 0 then
    return "wrong length"
  end
end

function ucp.dissector(tvb, pinfo, root)
  local tree = root:add(ucp, tvb())
  local reader = setmetatable({ tvb = tvb, at = 0, stop = tvb:captured_len(), tree = tree }, Reader)
  local info = {}
  local whole = tvb:captured_len() == tvb:reported_len()
  pinfo.cols.protocol = "UCP"
  local clear = tvb:captured_len() > 2 and tvb(2, 1):uint() == SECURED_VERSION and CLEAR_BYTES or HEADER_BYTES
  if not whole and tvb:captured_len() < clear then
    tree:add_proto_expert_info(cut_off)
    return
  end
  local reason = header(reader, info)
  if info.name then
    local text = info.name .. " from " .. info.sender .. (info.secured and ", secured" or "")
    tree:append_text(", " .. text)
    pinfo.cols.info = text
  end
  if not reason and not whole then
    tree:add_proto_expert_info(cut_off)
    return
  end
  reason = reason or body(reader, info)
  if reason then
    tree:add_proto_expert_info(malformed, reason)
    pinfo.cols.info:append(" [malformed: " .. reason .. "]")
  end
end

DissectorTable.get("udp.port"):add(PORT, ucp)
