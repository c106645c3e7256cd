"""A clock that nobody waits for, and a line to a brick that exists on paper only."""

from collections import deque
from dataclasses import dataclass, field

import pytest

from probewise.errors import LinkError


@dataclass
class Clock:
    """A clock that is moved by whoever waits."""

    now_s: float = 100.0

    def monotonic(self):
        return self.now_s

    def sleep(self, seconds):
        assert seconds >= 0
        self.now_s += seconds


@dataclass
class Script:
    """A line that expects frames in an order and answers each with bytes after a time.

    `expect(sent, *answers)` adds a frame as hexadecimal text; an answer is (seconds after it was sent, text).
    """

    clock: Clock
    name: str = "/dev/rfcomm0"
    expected: deque = field(default_factory=deque)
    coming: list = field(default_factory=list)
    sent_at: list = field(default_factory=list)
    is_open: bool = True
    cut_after: int | None = None

    def expect(self, sent, *answers):
        self.expected.append((bytes.fromhex(sent), [(after, bytes.fromhex(text)) for after, text in answers]))

    def write(self, data):
        if self.cut_after is not None and len(self.sent_at) >= self.cut_after:
            raise LinkError("cut")
        assert self.expected, f"not expected: {data.hex(' ')}"
        sent, answers = self.expected.popleft()
        assert data == sent, f"{data.hex(' ')} came, {sent.hex(' ')} was expected"
        self.sent_at.append(self.clock.now_s)
        self.coming += [(self.clock.now_s + after, content) for after, content in answers]
        self.coming.sort(key=lambda item: item[0])

    def read(self, size, timeout_s):
        end, got = self.clock.now_s + timeout_s, b""
        while len(got) < size and self.coming and self.coming[0][0] <= end:
            at, content = self.coming.pop(0)
            self.clock.now_s = max(self.clock.now_s, at)
            got, left = got + content[: size - len(got)], content[size - len(got) :]
            if left:
                self.coming.insert(0, (at, left))
        if len(got) < size:
            self.clock.now_s = end
        return got

    def close(self):
        self.is_open = False

    def finish(self):
        assert not self.expected, "a frame was expected and never sent"
        assert not self.coming, "bytes were left unread"


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def script(clock):
    return Script(clock)


@dataclass
class PaperMotor:
    """What the firmware does with a motor's limits, without inertia: it stops so far behind its target at once."""

    position: int = 0
    target: int = 0
    zero: int = 0
    power: int = 0
    run_state: int = 0
    limit: int = 0
    since_s: float = 0.0
    began_at: int = 0
    coast: float = 0.25  # counts by unit of power
    blocked_at: int | None = None
    is_faint: bool = False  # too little power to turn it

    def command(self, now_s, power, run_state, limit, *, regulated=True):
        self.look(now_s)
        self.power, self.run_state, self.limit = power, run_state, limit
        self.is_faint = abs(power) < 8 and not regulated
        self.since_s, self.began_at = now_s, self.position
        if limit:
            self.target += limit if power > 0 else -limit

    def look(self, now_s):
        """Turn as far as the time since the last command allows."""
        if self.run_state != 0x20 or not self.power:
            return
        side = 1 if self.power > 0 else -1
        position = self.began_at + (0 if self.is_faint else 1) * round(10 * self.power * (now_s - self.since_s))
        if self.blocked_at is not None and side * (position - self.blocked_at) > 0:
            self.position = self.blocked_at
            return
        if not self.limit:
            self.position = self.target = position
        elif side * (position - self.target) >= 0:
            self.position = max(side * self.began_at, side * self.target) * side
            self.position += round(self.coast * self.power) if side * (self.target - self.began_at) > 0 else 0
            self.run_state = 0
        else:
            self.position = position


@dataclass
class PaperBrick:
    """A brick that does what its telegrams say, after 60 ms; `lose` says what befalls the n-th one sent.

    Its value is "command" (never arrives) or "answer" (never comes back). `alter[n]` changes the n-th answer,
    `statuses` has the status of each opcode that is refused.
    """

    clock: Clock
    name: str = "paper"
    motors: tuple = field(default_factory=lambda: (PaperMotor(), PaperMotor(), PaperMotor()))
    raw_counts: int = 500
    lose: dict = field(default_factory=dict)
    alter: dict = field(default_factory=dict)
    statuses: dict = field(default_factory=lambda: {0x11: 0xEC})  # no program runs
    millivolt: int = 7412
    commands: list = field(default_factory=list)
    input: list = field(default_factory=lambda: [0, 0, 0.0])  # type, mode, valid from
    coming: list = field(default_factory=list)
    is_open: bool = True
    is_cut: bool = False

    def write(self, data):
        if self.is_cut:
            raise LinkError("the line is cut")
        lost = self.lose.pop(len(self.commands), None)
        alter = self.alter.pop(len(self.commands), bytes)
        assert int.from_bytes(data[:2], "little") == len(data) - 2
        self.commands.append(data[2:])
        if lost == "command":
            return
        status = self.statuses.get(data[3], 0)
        body = b"" if status else self.carry_out(data[3], data[4:])
        if not data[2] & 0x80 and lost != "answer":
            answer = alter(bytes([2, data[3], status]) + body)
            self.coming.append((self.clock.now_s + 0.06, len(answer).to_bytes(2, "little") + answer))

    def carry_out(self, opcode, body):
        now_s = self.clock.now_s
        if opcode == 0x04:
            power = body[1] - 256 if body[1] > 127 else body[1]
            for motor in self.motors if body[0] == 255 else [self.motors[body[0]]]:
                limit = int.from_bytes(body[6:10], "little")
                motor.command(now_s, power, body[5], limit, regulated=bool(body[2] & 4))
            return b""
        if opcode == 0x06:
            motor = self.motors[body[0]]
            motor.look(now_s)
            power = motor.power.to_bytes(1, "little", signed=True)
            counters = (motor.position, motor.position, motor.position - motor.zero)
            return b"".join(
                [body[:1], power, bytes([7, 1, 0, motor.run_state]), motor.limit.to_bytes(4, "little")]
                + [counter.to_bytes(4, "little", signed=True) for counter in counters]
            )
        if opcode == 0x0A:
            self.motors[body[0]].zero = self.motors[body[0]].position
            return b""
        if opcode == 0x05:
            self.input = [body[1], body[2], now_s + 0.1]
            return b""
        if opcode == 0x07:
            valid = now_s >= self.input[2]
            raw = self.raw_counts if valid else 1000
            shown = 1023 - min(max(raw - 200, 0) * 100 // 68, 1023)  # LEGO's firmware, types 05 and 06 in mode 00
            words = [raw, shown, shown, shown]
            return bytes([body[0], valid, 0, *self.input[:2]]) + b"".join(word.to_bytes(2, "little") for word in words)
        if opcode == 0x0B:
            return self.millivolt.to_bytes(2, "little")
        return {
            0x11: b"dance.rxe".ljust(20, b"\0"),
            0x9B: b"ARM1".ljust(30, b"\0"),
            0x0D: b"\xc0\x27\x09\x00",
            0x88: b"\x7c\x01\x1f\x01",
        }[opcode]

    def read(self, size, timeout_s):
        end = self.clock.now_s + timeout_s
        if not self.coming or self.coming[0][0] > end:
            self.clock.now_s = end
            return b""
        at, content = self.coming.pop(0)
        self.clock.now_s = max(self.clock.now_s, at)
        if len(content) > size:
            self.coming.insert(0, (at, content[size:]))
        return content[:size]

    def close(self):
        self.is_open = False

    def drives(self):
        """Every command that turns a motor: port, power, limit."""
        sent = [body for body in self.commands if body[1] == 0x04 and abs(body[3] - 256 * (body[3] > 127)) > 1]
        return [
            (body[2], body[3] - 256 if body[3] > 127 else body[3], int.from_bytes(body[8:12], "little"))
            for body in sent
        ]

    @property
    def n_sought(self):
        """How often a motor's target was sought, by driving it without a limit."""
        return sum(body[1] == 0x04 and body[3] == 1 and not any(body[8:12]) for body in self.commands)

    @property
    def at_rest(self):
        return all(motor.run_state == 0 or motor.power == 0 for motor in self.motors)


@pytest.fixture
def paper_brick(clock):
    return PaperBrick(clock)


@pytest.fixture(scope="session")
def make_paper_brick():
    """Make bricks, for a test that needs a new one each time."""
    return lambda: PaperBrick(Clock())
