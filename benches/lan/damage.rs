//! Damaged and random datagrams at a listener: what it takes of them, what it says of them, and what its memory does.

use std::process::Command;

use schema::datagram::{DatagramError, HEAD, Head, MTU_ETHERNET, Packed};
use schema::{Topic, Verdict, Zones};

use crate::source;
use crate::support::Outcome;
use crate::support::figures::{Figure, Target};
use crate::wire::{self, Program, number};

/// Between two that are whole; what a listener's buffer surely holds.
const TURN: u64 = 50;

/// Sends `count` of them.
pub(crate) fn figures(count: u64) -> Outcome<Vec<Figure>> {
    let mut command = Command::new(wire::PROGRAM);
    command.args(["listen", "--json", "--interface=lo", "--topic=zones"]);
    let listener = Program::start(command, "ready")?;
    let (mouth, to) = (wire::mouth()?, wire::address(Topic::Zones));
    let mut random = fastrand::Rng::with_seed(6);
    let mut buffer = [0; MTU_ETHERNET];
    let scan = sealed(&mut buffer, Topic::Scan, 0, &*source::scan())?;
    let whole = [scan, sealed(&mut buffer, Topic::Zones, 0, &Zones::unknown())?];
    let (mut sequence, mut begin_kb) = (0, 0);
    for n in 1..=count {
        mouth.send_to(&damaged(&mut random, &whole), to)?;
        if n % TURN == 0 {
            let zones = Zones { verdict: Verdict::Stop as u8, ..Zones::unknown() };
            mouth.send_to(&sealed(&mut buffer, Topic::Zones, sequence, &zones)?, to)?;
            sequence += 1;
            listener.await_class("zones")?;
        }
        if n == count / 10 {
            begin_kb = resident_kb(&listener)?;
        }
    }
    let grown_kb = resident_kb(&listener)?.saturating_sub(begin_kb);
    let lines = listener.end()?;
    let of_class = |class| lines.iter().map(|(_, line)| line).filter(move |line| line["class"] == class);
    let refused = of_class("lan_refused").next().ok_or("no account")?;
    let counts = DatagramError::ALL.map(|reason| (reason.name(), number(refused, reason.name())));
    let counted: u64 = counts.iter().map(|(_, count)| count).sum();
    for (name, count) in counts.iter().filter(|(_, count)| *count > 0) {
        eprintln!("refused as {name}: {count}");
    }
    let received: u64 = of_class("lan").map(|line| number(line, "received")).sum();
    let figure = |name, hub, target| Figure { name, unit: "1", hub: vec![hub], floor: Vec::new(), target };
    let most = |name, hub: u64| figure(name, hub as f64, Target::Most(0.0));
    Ok(vec![
        figure("damaged: sent", count as f64, Target::None),
        most("damaged: refused without reason", count - counted.min(count)),
        most("damaged: taken and not sent", received.saturating_sub(u64::from(sequence))),
        most("whole: sent and not taken", u64::from(sequence).saturating_sub(received)),
        Figure { unit: "kB", ..figure("damaged: memory grown", grown_kb as f64, Target::Most(512.0)) },
    ])
}

fn sealed(
    buffer: &mut [u8],
    topic: Topic,
    sequence: u32,
    payload: &(impl Packed + ?Sized),
) -> Outcome<Vec<u8>> {
    let len = payload.pack(&mut buffer[HEAD..]).ok_or("it does not fit")?;
    let head = Head { topic: topic.number(), hub: 1, epoch: 1, sequence, revision: 1, ..Head::default() };
    Ok(head.seal(buffer, len).ok_or("it does not fit")?.to_vec())
}

/// One of `whole` with some bits, its end, or all of its rest changed; or noise.
fn damaged(random: &mut fastrand::Rng, whole: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = whole[random.usize(..whole.len())].clone();
    match random.u8(..5) {
        0 => (0..random.usize(1..4)).for_each(|_| {
            let bit = random.usize(..8 * bytes.len());
            bytes[bit / 8] ^= 1 << (bit % 8);
        }),
        1 => bytes.truncate(random.usize(..bytes.len())),
        2 => bytes.extend((0..random.usize(1..40)).map(|_| random.u8(..))),
        3 => {
            let begin = random.usize(..bytes.len());
            bytes[begin..].iter_mut().for_each(|byte| *byte = random.u8(..));
            bytes[begin] ^= 1;
        }
        _ => bytes = (0..random.usize(..MTU_ETHERNET)).map(|_| random.u8(..)).collect(),
    }
    // Flips may have undone each other.
    if whole.contains(&bytes) {
        bytes[0] ^= 0x80;
    }
    bytes
}

fn resident_kb(program: &Program) -> Outcome<u64> {
    let text = std::fs::read_to_string(format!("/proc/{}/status", program.pid()))?;
    let line = text.lines().find(|line| line.starts_with("VmRSS")).ok_or("no memory")?;
    Ok(line.split_whitespace().nth(1).ok_or("no number")?.parse()?)
}
