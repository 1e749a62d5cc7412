//! What a host reads if its port runs at another rate than the line: bytes become bits at the sender's rate and are
//! sampled at the receiver's. An ideal UART that samples a little early agrees with recordings of real ones; bytes with a
//! wrong stop bit are delivered, as Linux does. Refuses to know what the bytes were.

use std::collections::VecDeque;

/// A receiver at the wrong rate.
#[derive(Clone, Debug)]
pub struct Receiver {
    /// Sender's bits in one of the receiver's.
    ratio: f64,
    /// Levels of the line not looked at yet; the first is bit number `first`.
    line: VecDeque<bool>,
    first: u64,
    state: State,
}

/// A port that may run at another rate than the line, whose rate also changes: starts again with each new pair of rates.
#[derive(Clone, Debug, Default)]
pub struct Mistuned(Option<((u32, u32), Receiver)>);

impl Mistuned {
    /// As [`Receiver::receive`], for a port at the second of `rates` on a line at the first, in bits per second.
    pub fn receive(&mut self, rates: (u32, u32), bytes: &[u8], idle_after: bool) -> Vec<u8> {
        let known = self.0.take().filter(|(known, _)| *known == rates);
        let (_, receiver) = self.0.insert(known.unwrap_or_else(|| (rates, Receiver::new(rates.0, rates.1))));
        receiver.receive(bytes, idle_after)
    }

    /// Both ends have one rate: what was half read is forgotten.
    pub fn tune(&mut self) {
        self.0 = None;
    }
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// Waits for a falling edge after bit number `after`, whose level was `level`.
    Hunting { after: u64, level: bool },
    /// A start bit fell at the beginning of bit number `start`; `bits` data bits were sampled.
    Sampling { start: u64, bits: u32, byte: u8 },
}

impl Receiver {
    /// A receiver at `receiver_rate` bits per second on a line of `sender_rate`.
    pub fn new(sender_rate: u32, receiver_rate: u32) -> Self {
        Receiver {
            ratio: f64::from(sender_rate) / f64::from(receiver_rate.max(1)),
            line: VecDeque::new(),
            first: 0,
            state: State::Hunting { after: 0, level: true },
        }
    }

    /// What it reads when `bytes` follow without a pause, and then, if `idle_after`, the line is idle.
    pub fn receive(&mut self, bytes: &[u8], idle_after: bool) -> Vec<u8> {
        for &byte in bytes {
            self.line.push_back(false);
            self.line.extend((0..8).map(|bit| byte >> bit & 1 == 1));
            self.line.push_back(true);
        }
        if idle_after {
            // As long as a whole byte of the receiver's takes: nothing is left half read.
            let bits = (11.0 * self.ratio).ceil() as usize + 1;
            self.line.extend(std::iter::repeat_n(true, bits));
        }
        let mut read = Vec::new();
        while let Some(byte) = self.next() {
            read.extend(byte);
        }
        read
    }

    /// One step: `None` when more bits are needed, `Some(None)` when nothing came of it.
    fn next(&mut self) -> Option<Option<u8>> {
        match self.state {
            State::Hunting { after, level } => {
                let now = self.level(after)?;
                self.state = if level && !now {
                    State::Sampling { start: after, bits: 0, byte: 0 }
                } else {
                    State::Hunting { after: after + 1, level: now }
                };
                Some(None)
            }
            State::Sampling { start, bits, byte } => {
                let at = start + ((1.0 + f64::from(bits) + SAMPLE_POSITION) * self.ratio) as u64;
                let level = self.level(at)?;
                if bits == 8 {
                    self.state = State::Hunting { after: at + 1, level };
                    return Some(Some(byte));
                }
                self.state = State::Sampling { start, bits: bits + 1, byte: byte | u8::from(level) << bits };
                Some(None)
            }
        }
    }

    /// Level of bit number `at`; forgets what lies before it.
    fn level(&mut self, at: u64) -> Option<bool> {
        let skip = (at - self.first).min(self.line.len() as u64);
        self.line.drain(..skip as usize);
        self.first += skip;
        if self.first == at { self.line.front().copied() } else { None }
    }
}

/// Where in its bit the receiver samples: 0.40 to 0.48 agree with a recording of a real port at 19200 on a line of
/// 38400, 0.5 and later do not (reference, section 2).
const SAMPLE_POSITION: f64 = 0.45;

#[cfg(test)]
#[path = "../../../tests/testkit/skip.rs"]
mod skip;

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;
    use std::path::PathBuf;

    #[test]
    fn at_the_right_rate_nothing_changes() {
        let bytes: Vec<u8> = (0..=255).collect();
        for rate in [9_600, 9_500, 9_700] {
            assert_eq!(Receiver::new(9_600, rate).receive(&bytes, true), bytes, "{rate}");
        }
        let mut receiver = Receiver::new(500_000, 500_000);
        let mut read = Vec::new();
        for chunk in bytes.chunks(16) {
            read.extend(receiver.receive(chunk, false));
        }
        read.extend(receiver.receive(&[], true));
        assert_eq!(read, bytes);
    }

    #[test]
    fn a_faster_host_reads_zeros() {
        let read = Receiver::new(38_400, 500_000).receive(&[0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x41], true);
        assert!(read.len() > 7 && read.iter().all(|&byte| byte == 0), "{read:02X?}");
    }

    #[test]
    fn a_slower_host_reads_less() {
        let bytes: Vec<u8> = (0..20_000u32).map(|i| ((i * i) >> 3) as u8).collect();
        for (rate, share) in [(19_200, 0.5), (9_600, 0.25)] {
            let read = Receiver::new(38_400, rate).receive(&bytes, true).len() as f64 / bytes.len() as f64;
            assert!((read - share).abs() < 0.08 * share, "{rate}: {read}");
        }
    }

    /// The recording of a host at 19200 on a line of 38400, against the model fed with what that sensor sent.
    #[test]
    fn agrees_with_a_recording() {
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
        let model = Receiver::new(38_400, 19_200).receive(&sent, true);
        let grams: HashSet<&[u8]> = model.windows(4).collect();
        let found = real.windows(4).filter(|gram| grams.contains(gram)).count();
        // The recordings show different scenes; with a sample position of 0.5 none at all is found.
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
