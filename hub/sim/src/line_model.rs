//! The line between scanner and port, with all its faults. Time is an argument, so that ptys and tests in virtual time
//! share this model.
//!
//! A [`LineModel`] is driven like a [`Device`]: call [`LineModel::poll_transmit`] until it returns `None`, and pass the
//! host's bytes to [`LineModel::receive`]. Repeat both at the time that [`LineModel::poll_timeout`] returns.
//!
//! The line model does not depend on the rate of the host's port. If this rate differs from the rate of the line, the
//! caller passes delivered bytes through a [`UartReceiver`]. The receiver converts the bytes to bits at the rate of the
//! sender, and samples the bits at its own rate. An ideal UART that samples a little before the middle of a bit agrees
//! with recordings of real UARTs. The receiver delivers bytes with a wrong stop bit, as Linux does.

use std::collections::VecDeque;

use scanhub_schema::Nanos;

use crate::device::{Chunk, ChunkKind, Device, SentTelegram};
use crate::fault::{
    ByteOutcome, Delay, Fault, FaultWindow, Faults, Garbage, Noise, Schedule, TelegramFaults,
};
use crate::request_decoder::Arrival;

/// Bytes that arrive at once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Delivery {
    /// The bytes that arrive, including bytes that the scanner did not send. Empty if all bytes were lost.
    pub bytes: Vec<u8>,
    /// Rate at which the bytes were sent, in bits per second.
    pub rate: u32,
    /// Whether the line is idle after these bytes.
    pub idle_after: bool,
    /// The part of a telegram that the scanner sent; `None` for bytes that the scanner did not send.
    pub part: Option<ChunkKind>,
    /// First cause for which this part of the telegram did not arrive as sent; `None` if it arrived as sent.
    pub fault: Option<Fault>,
}

/// The line between a scanner and the port of a host.
#[derive(Clone, Debug)]
pub struct LineModel {
    noise: Noise,
    telegram_faults: TelegramFaults,
    garbage_faults: [Garbage; 2],
    silence: FaultWindow,
    delay: Delay,
    unplug: FaultWindow,
    power: Schedule,
    brownouts: Schedule,
    /// Whether this is an RS-232 line, which carries nothing at [`RS422_RATE`] or more.
    is_rs232: bool,
    /// Whether the adapter is plugged in.
    plugged: bool,
    /// Number of bytes of the current telegram that the scanner has sent.
    position: usize,
    /// The last byte that the scanner has sent.
    last: u8,
    /// First cause for which a byte of the current telegram did not arrive as sent.
    fault: Option<Fault>,
    /// Whether a power cycle aborted the current telegram.
    power_broke: bool,
    /// Length of a telegram, if all telegrams have the same length.
    telegram_len: Option<usize>,
    /// First bytes of the last telegram of the stream, which runs of start bytes imitate.
    header: Vec<u8>,
    /// Bytes that have not arrived yet, with the times of their arrival.
    queue: VecDeque<(Nanos, Delivery)>,
}

impl LineModel {
    /// Creates a line with `faults`, drawn with `seed`.
    pub fn new(faults: &Faults, seed: u64) -> LineModel {
        LineModel {
            noise: Noise::new(faults, seed),
            telegram_faults: TelegramFaults::new(faults, seed),
            garbage_faults: [Garbage::floods(faults, seed), Garbage::walls(faults, seed)],
            silence: FaultWindow::silences(faults, seed),
            delay: Delay::new(faults, seed),
            unplug: FaultWindow::unplugs(faults, seed),
            power: Schedule::power_cycles(faults, seed),
            brownouts: Schedule::brownouts(faults, seed),
            is_rs232: faults.rs232 > 0.0,
            plugged: true,
            position: 0,
            last: 0,
            fault: None,
            power_broke: false,
            telegram_len: None,
            header: Vec::new(),
            queue: VecDeque::new(),
        }
    }

    /// Replaces the faults from now on, and draws new random numbers. Bytes that were sent before do not change.
    pub fn set_faults(&mut self, faults: &Faults, seed: u64) {
        let fresh = LineModel::new(faults, seed);
        let delay = fresh.delay.after(&self.delay);
        let (queue, header) = (std::mem::take(&mut self.queue), std::mem::take(&mut self.header));
        let LineModel { position, last, fault, power_broke, .. } = *self;
        *self = LineModel { delay, position, last, fault, power_broke, queue, header, ..fresh };
    }

    /// Unplugs the host's adapter from `now` on for `span`, in addition to the faults.
    pub fn unplug(&mut self, now: Nanos, span: Nanos) {
        self.unplug = FaultWindow::once(now, span);
    }

    /// Switches the power of `machine` off and on at `now`.
    pub fn cycle_power(&mut self, machine: &mut dyn Device, now: Nanos) {
        self.power_broke |= machine.power_cycle(now);
    }

    /// Returns whether the host's adapter was plugged in at the last poll.
    pub fn is_plugged(&self) -> bool {
        self.plugged
    }

    /// Passes a byte of the host to `machine`, if the line carries it. Before, call [`LineModel::poll_transmit`] until
    /// it returns `None`.
    pub fn receive(&mut self, machine: &mut dyn Device, byte: u8, arrival: Arrival) {
        if self.plugged && self.carries(machine.rate()) {
            machine.receive(byte, arrival);
        }
    }

    /// Returns the next bytes that have arrived at `now`, or `None` if there are no more.
    pub fn poll_transmit(&mut self, machine: &mut dyn Device, now: Nanos) -> Option<Delivery> {
        self.plugged = !self.unplug.is_active(now);
        if self.power.take(now).is_some() {
            self.cycle_power(machine, now);
        }
        if self.brownouts.take(now).is_some() {
            self.power_broke |= machine.brown_out(now);
        }
        loop {
            if self.queue.front().is_some_and(|(at, _)| *at <= now)
                && let Some((_, mut delivery)) = self.queue.pop_front()
            {
                if !self.plugged && !std::mem::take(&mut delivery.bytes).is_empty() {
                    delivery.fault = delivery.fault.or(delivery.is_telegram().then_some(Fault::Unplug));
                }
                return Some(delivery);
            }
            match machine.poll_transmit(now) {
                Some(chunk) => self.transmit(machine, chunk, now),
                None => {
                    if self.position > 0 {
                        return None;
                    }
                    let bytes = Some(self.due_garbage(now, false)?.0);
                    let bytes = bytes.filter(|_| !self.is_silent(machine.rate(), now)).unwrap_or_default();
                    let rate = machine.rate();
                    self.push(now, Delivery { bytes, rate, idle_after: true, part: None, fault: None });
                }
            }
        }
    }

    /// Returns the time after `now` at which the next bytes can arrive.
    pub fn poll_timeout(&self, machine: &dyn Device, now: Nanos) -> Option<Nanos> {
        let extras =
            self.garbage_faults.iter().filter(|_| self.position == 0).map(|extra| extra.due_ns(false));
        extras
            .chain(machine.poll_timeout())
            .chain(self.queue.front().map(|(at, _)| *at))
            .chain([self.power.next_ns(), self.brownouts.next_ns(), self.unplug.next_ns(now)])
            .filter(|&at| at < Nanos::MAX)
            .min()
    }

    /// Applies the faults to a chunk whose transmission is complete, and queues the resulting bytes for the host.
    fn transmit(&mut self, machine: &mut dyn Device, chunk: Chunk, now: Nanos) {
        let Chunk { bytes, rate, idle_after, part } = chunk;
        let is_silent = self.is_silent(rate, now);
        self.telegram_len = machine.telegram_len();
        let (arrived, mut fault) = match &part {
            ChunkKind::Acknowledge => (self.damage_acknowledge(&bytes), None),
            ChunkKind::Telegram => self.damage_telegram(&bytes, usize::MAX, is_silent, now),
            ChunkKind::End(sent) => self.damage_telegram(&bytes, sent.telegram.len(), is_silent, now),
        };
        let arrived = if is_silent { Vec::new() } else { arrived };
        let mut copy = None;
        if let ChunkKind::End(sent) = &part {
            let cause = if std::mem::take(&mut self.power_broke) { Fault::Power } else { Fault::Aborted };
            fault = fault.or(sent.aborted.then_some(cause));
            copy = self.end_telegram(sent, fault);
        } else if machine.streams() && self.telegram_faults.aborts_at(self.position) {
            machine.abort(now);
        }
        self.push(now, Delivery { bytes: arrived, rate, idle_after, part: Some(part), fault });
        if let Some(sent) = copy {
            let bytes = sent.telegram.clone();
            self.push(
                now,
                Delivery { bytes, rate, idle_after, part: Some(ChunkKind::End(sent)), fault: None },
            );
        }
    }

    /// Returns whether the line carries bytes at `rate`, in bits per second.
    fn carries(&self, rate: u32) -> bool {
        !self.is_rs232 || rate < RS422_RATE
    }

    /// Returns whether the line loses every byte that is sent at `now`, at `rate` bits per second.
    fn is_silent(&mut self, rate: u32, now: Nanos) -> bool {
        self.silence.is_active(now) || !self.carries(rate)
    }

    fn damage_acknowledge(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut arrived = Vec::new();
        for &byte in bytes {
            let ByteOutcome { inserted, is_lost, flip_mask, is_doubled } = self.noise.next();
            arrived.extend(inserted);
            let copies = if is_lost { 0 } else { 1 + usize::from(is_doubled) };
            arrived.extend(std::iter::repeat_n(byte ^ flip_mask, copies));
        }
        arrived
    }

    /// Returns the bytes that arrive if the scanner sends `bytes` of a telegram, and the first fault of these bytes.
    /// The telegram has `len` bytes; `usize::MAX` means that these bytes do not end the telegram.
    fn damage_telegram(
        &mut self,
        bytes: &[u8],
        len: usize,
        is_silent: bool,
        now: Nanos,
    ) -> (Vec<u8>, Option<Fault>) {
        let mut arrived = Vec::with_capacity(bytes.len());
        let mut fault = None;
        for &byte in bytes {
            let position = self.position;
            self.position += 1;
            if position == 0 {
                self.telegram_faults.begin(self.telegram_len);
                self.fault = None;
                self.last = byte;
            }
            fault = fault.or(is_silent.then_some(Fault::Silence));
            let between = (position > 0).then(|| (std::mem::replace(&mut self.last, byte), byte));
            if let Some((garbage, cause)) = self.due_garbage(now, position > 0) {
                arrived.extend(separated(garbage, between));
                fault = fault.or(between.map(|_| cause));
            }
            let ByteOutcome { inserted, is_lost, flip_mask, is_doubled } = self.noise.next();
            let (changed, telegram_fault) = self.telegram_faults.apply(position, byte);
            fault = fault.or((position > 0 && !inserted.is_empty()).then_some(Fault::Insert));
            arrived.extend(separated(inserted, between));
            fault = fault.or(telegram_fault).or(is_lost.then_some(Fault::Loss));
            let Some(byte) = changed.filter(|_| !is_lost) else { continue };
            fault = fault.or((flip_mask != 0).then_some(Fault::Flip));
            // The first copy of a doubled first byte precedes the intact telegram, and the second copy of a doubled
            // last byte follows it. Neither damages the telegram.
            let splits = is_doubled && position > 0 && position + 1 < len;
            fault = fault.or(splits.then_some(Fault::Double));
            arrived.extend(std::iter::repeat_n(byte ^ flip_mask, 1 + usize::from(is_doubled)));
        }
        self.fault = self.fault.or(fault);
        (arrived, fault)
    }

    /// Ends the current telegram. Returns a copy of the telegram if it arrived intact and is to arrive twice.
    fn end_telegram(&mut self, sent: &SentTelegram, fault: Option<Fault>) -> Option<SentTelegram> {
        self.position = 0;
        if !sent.is_reply {
            self.header = sent.telegram[..HEADER_LEN.min(sent.telegram.len())].to_vec();
        }
        let is_whole = self.fault.or(fault).is_none();
        (is_whole && self.telegram_faults.is_repeated()).then(|| sent.clone())
    }

    /// Returns the garbage that is due at `now`, and its kind. `inside` selects garbage inside a telegram; otherwise
    /// the garbage is between two telegrams.
    fn due_garbage(&mut self, now: Nanos, inside: bool) -> Option<(Vec<u8>, Fault)> {
        if self.garbage_faults.iter().all(|extra| extra.due_ns(inside) > now) {
            return None;
        }
        let header = &self.header;
        self.garbage_faults.iter_mut().find_map(|extra| Some((extra.take(now, inside, header)?, extra.fault)))
    }

    fn push(&mut self, now: Nanos, delivery: Delivery) {
        self.queue.push_back((self.delay.release_ns(now), delivery));
    }
}

impl Delivery {
    /// Returns whether the bytes belong to a telegram.
    pub fn is_telegram(&self) -> bool {
        matches!(self.part, Some(ChunkKind::Telegram | ChunkKind::End(_)))
    }
}

/// Returns the foreign `bytes` between two bytes of a telegram, changed so that the last foreign byte differs from the
/// byte before them, and the first foreign byte differs from the byte after them. `between` contains these two bytes of
/// the telegram. Otherwise, a foreign byte could take the place of its neighbor, and the telegram would still be
/// contiguous.
fn separated(mut bytes: Vec<u8>, between: Option<(u8, u8)>) -> Vec<u8> {
    if let (Some((before, after)), [first, rest @ ..]) = (between, &mut bytes[..]) {
        let last = rest.last_mut();
        let is_alone = last.is_none();
        if let Some(last) = last.filter(|last| **last == before) {
            *last ^= 1;
        }
        while *first == after || (is_alone && *first == before) {
            *first = first.wrapping_add(1);
        }
    }
    bytes
}

/// A receiver at the wrong rate.
#[derive(Clone, Debug)]
pub struct UartReceiver {
    /// Duration of one bit of the receiver, in bits of the sender.
    ratio: f64,
    /// Levels of the line that were not sampled yet. The first level is bit number `first`.
    levels: VecDeque<bool>,
    first: u64,
    state: ReceiverState,
}

/// Receiver of a port whose rate may differ from the rate of the line. If one of the two rates changes, the receiver
/// restarts.
#[derive(Clone, Debug, Default)]
pub struct BaudMismatch(Option<((u32, u32), UartReceiver)>);

impl BaudMismatch {
    /// Receives bytes like [`UartReceiver::receive`]. `rates` has the rate of the line and the rate of the port, in
    /// bits per second.
    pub fn receive(&mut self, rates: (u32, u32), bytes: &[u8], idle_after: bool) -> Vec<u8> {
        let known = self.0.take().filter(|(known, _)| *known == rates);
        let (_, receiver) =
            self.0.insert(known.unwrap_or_else(|| (rates, UartReceiver::new(rates.0, rates.1))));
        receiver.receive(bytes, idle_after)
    }

    /// Drops a byte that was partly received. The caller calls this function when both ends have the same rate.
    pub fn reset(&mut self) {
        self.0 = None;
    }
}

#[derive(Clone, Copy, Debug)]
enum ReceiverState {
    /// Waits for a falling edge at the beginning of bit number `after` or of a later bit. The bit before had `level`.
    Hunting { after: u64, level: bool },
    /// Samples a byte whose start bit began with bit number `start` of the sender. `bits` data bits have been sampled.
    Sampling { start: u64, bits: u32, byte: u8 },
}

impl UartReceiver {
    /// Creates a receiver at `receiver_rate` bits per second on a line at `sender_rate`.
    pub fn new(sender_rate: u32, receiver_rate: u32) -> Self {
        UartReceiver {
            ratio: f64::from(sender_rate) / f64::from(receiver_rate.max(1)),
            levels: VecDeque::new(),
            first: 0,
            state: ReceiverState::Hunting { after: 0, level: true },
        }
    }

    /// Returns the bytes that the receiver reads if the sender sends `bytes` without a pause. If `idle_after` is set,
    /// the line is idle afterwards.
    pub fn receive(&mut self, bytes: &[u8], idle_after: bool) -> Vec<u8> {
        for &byte in bytes {
            self.levels.push_back(false);
            self.levels.extend((0..8).map(|bit| byte >> bit & 1 == 1));
            self.levels.push_back(true);
        }
        if idle_after {
            // Let the line be idle for more than the duration of one byte at the receiver's rate. The receiver can then
            // complete its last byte.
            let bits = (11.0 * self.ratio).ceil() as usize + 1;
            self.levels.extend(std::iter::repeat_n(true, bits));
        }
        let mut read = Vec::new();
        while let Some(byte) = self.next() {
            read.extend(byte);
        }
        read
    }

    /// Takes one step of the receiver. Returns `None` if more bits are needed, and `Some(None)` if the step completed
    /// no byte.
    fn next(&mut self) -> Option<Option<u8>> {
        match self.state {
            ReceiverState::Hunting { after, level } => {
                let now = self.level(after)?;
                self.state = if level && !now {
                    ReceiverState::Sampling { start: after, bits: 0, byte: 0 }
                } else {
                    ReceiverState::Hunting { after: after + 1, level: now }
                };
                Some(None)
            }
            ReceiverState::Sampling { start, bits, byte } => {
                let at = start + ((1.0 + f64::from(bits) + SAMPLE_POSITION) * self.ratio) as u64;
                let level = self.level(at)?;
                if bits == 8 {
                    self.state = ReceiverState::Hunting { after: at + 1, level };
                    return Some(Some(byte));
                }
                self.state =
                    ReceiverState::Sampling { start, bits: bits + 1, byte: byte | u8::from(level) << bits };
                Some(None)
            }
        }
    }

    /// Returns the level of bit number `at`, and drops earlier bits.
    fn level(&mut self, at: u64) -> Option<bool> {
        let skip = (at - self.first).min(self.levels.len() as u64);
        self.levels.drain(..skip as usize);
        self.first += skip;
        if self.first == at { self.levels.front().copied() } else { None }
    }
}

/// Lowest rate that an RS-232 line does not carry, in bits per second.
const RS422_RATE: u32 = 500_000;
/// Number of bytes at the start of a stream's telegram that runs of start bytes imitate: STX to count word.
const HEADER_LEN: usize = 7;
/// Position in a bit at which the receiver samples, from 0 at its beginning to 1 at its end. Positions from 0.40 to
/// 0.48 agree with a recording of a real port at 19200 on a line at 38400. Positions of 0.5 and more do not agree with
/// the recording (reference, section 2).
const SAMPLE_POSITION: f64 = 0.45;

#[cfg(test)]
#[path = "../../../tests/testkit/skip.rs"]
mod skip;

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::path::PathBuf;

    use super::*;

    #[test]
    fn matching_rate_changes_no_byte() {
        let bytes: Vec<u8> = (0..=255).collect();
        for rate in [9_600, 9_500, 9_700] {
            assert_eq!(UartReceiver::new(9_600, rate).receive(&bytes, true), bytes, "{rate}");
        }
        let mut receiver = UartReceiver::new(500_000, 500_000);
        let mut read = Vec::new();
        for chunk in bytes.chunks(16) {
            read.extend(receiver.receive(chunk, false));
        }
        read.extend(receiver.receive(&[], true));
        assert_eq!(read, bytes);
    }

    #[test]
    fn faster_host_reads_zeros() {
        let read =
            UartReceiver::new(38_400, 500_000).receive(&[0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x41], true);
        assert!(read.len() > 7 && read.iter().all(|&byte| byte == 0), "{read:02X?}");
    }

    #[test]
    fn slower_host_reads_fewer_bytes() {
        let bytes: Vec<u8> = (0..20_000u32).map(|i| ((i * i) >> 3) as u8).collect();
        for (rate, share) in [(19_200, 0.5), (9_600, 0.25)] {
            let read =
                UartReceiver::new(38_400, rate).receive(&bytes, true).len() as f64 / bytes.len() as f64;
            assert!((read - share).abs() < 0.08 * share, "{rate}: {read}");
        }
    }

    /// Compares a recording of a host at 19200 on a line at 38400 with the output of the model for the bytes that the
    /// scanner sent.
    #[test]
    fn line_model_agrees_with_a_recording() {
        let data = std::env::var_os("SCANHUB_DATA").map_or_else(
            || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")),
            PathBuf::from,
        );
        let read = |name: &str| std::fs::read(data.join("captures").join(name));
        let (Ok(real), Ok(sent)) = (read("host19200_while_sensor_38400.bin"), read("lms200_38400.bin"))
        else {
            super::skip::skip("recordings", format!("none at {}", data.display()));
            return;
        };
        let model = UartReceiver::new(38_400, 19_200).receive(&sent, true);
        let grams: HashSet<&[u8]> = model.windows(4).collect();
        let found = real.windows(4).filter(|gram| grams.contains(gram)).count();
        // The two recordings show different scenes, so only a part of the runs agrees. With a sample position of 0.5,
        // no run agrees.
        println!("{found} of {} runs of 4 bytes are in the model's output", real.len() - 3);
        assert!(found > 3_000, "{found}");
        let histogram = |bytes: &[u8]| {
            let mut counts = [0.0f64; 256];
            bytes.iter().for_each(|&byte| counts[usize::from(byte)] += 1.0 / bytes.len() as f64);
            counts
        };
        let (a, b) = (histogram(&real), histogram(&model));
        let distance = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).sum::<f64>() / 2.0;
        println!("histogram distance {distance:.3}");
        assert!(distance < 0.55, "{distance}");
    }
}
