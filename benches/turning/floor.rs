//! The floor of a hub whose scanners send packets without pause: sleep until there are bytes, rest 5 ms as the hub does,
//! take all of them, and wake two sleeping processes once a turn. No framing, no checksum, no shared memory.

use std::os::fd::OwnedFd;
use std::path::Path;
use std::thread;

use rustix::event::{EventfdFlags, eventfd};

use crate::support::bare;
use crate::support::child::Guard;
use crate::support::line::Line;
use crate::support::{Outcome, clock};

/// Reads each of `ports` for ever in a thread of its own; a turn has `turn` bytes.
pub(crate) fn coalesce(turn: usize, ports: &[&str]) -> Outcome<()> {
    let mut sleepers: Vec<Guard> = Vec::new();
    let mut readers = Vec::new();
    for (number, port) in ports.iter().enumerate() {
        let mut ends: Vec<OwnedFd> = Vec::new();
        for _ in 0..CONSUMERS {
            let wake = eventfd(0, EventfdFlags::CLOEXEC)?;
            sleepers.push(bare::start_sleeper(number, 0, wake.try_clone()?)?);
            ends.push(wake);
        }
        // The rate means nothing to a pty.
        let line = Line::open(Path::new(port), 115_200)?;
        readers.push(thread::spawn(move || {
            if let Err(error) = read(&line, &ends, turn) {
                // One reader less would be a floor too low: if one ends early, all do.
                eprintln!("floor: {error}");
                std::process::exit(1)
            }
        }));
    }
    for reader in readers {
        reader.join().map_err(|_| "a reader panicked")?;
    }
    Ok(())
}

fn read(line: &Line, ends: &[OwnedFd], turn: usize) -> Outcome<()> {
    let mut buffer = [0; 4096];
    let mut since = 0;
    loop {
        clock::readable(line, None)?;
        clock::rest(clock::now() + REST);
        since += line.read(&mut buffer)?;
        if since >= turn {
            since -= turn;
            for end in ends {
                rustix::io::write(end, &1u64.to_ne_bytes())?;
            }
        }
    }
}

/// Consumers of a scanner.
const CONSUMERS: usize = 2;
/// How long the hub leaves packets in the line, in ns.
const REST: u64 = 5_000_000;
