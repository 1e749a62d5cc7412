//! The fuzzer's targets without the fuzzer: over the corpus that it has left, over pieces of it and over seeded noise.
//! `tests/fuzz/README.md` tells how to look for more.

// Public for the fuzzer, which has them as a crate.
#[allow(unreachable_pub)]
#[path = "../fuzz/targets.rs"]
mod targets;

use std::fs;
use std::path::Path;

use fastrand::Rng;

/// Inputs of one target that were worth keeping.
fn corpus(target: &str) -> Vec<Vec<u8>> {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus").join(target);
    let mut entries: Vec<_> =
        fs::read_dir(&directory).expect("a corpus").map(|entry| entry.expect("an entry").path()).collect();
    entries.sort();
    assert!(!entries.is_empty(), "{} is empty", directory.display());
    entries.iter().map(|path| fs::read(path).expect("a readable input")).collect()
}

/// One input with a few bytes changed, doubled, dropped or taken from another one.
fn mutated(random: &mut Rng, corpus: &[Vec<u8>]) -> Vec<u8> {
    let mut input = corpus[random.usize(..corpus.len())].clone();
    for _ in 0..random.usize(1..8) {
        let at = random.usize(..=input.len());
        match random.u8(..5) {
            0 if at < input.len() => input[at] = random.u8(..),
            1 if at < input.len() => input[at] ^= 1 << random.u8(..8),
            2 => input.truncate(at),
            3 => {
                let other = &corpus[random.usize(..corpus.len())];
                let from = random.usize(..=other.len());
                let to = random.usize(from..=other.len()).min(from + 300);
                input.splice(at..at, other[from..to].iter().copied());
            }
            _ => input.insert(at, random.u8(..)),
        }
    }
    input.truncate(MOST);
    input
}

fn run(name: &str) {
    let (_, target) = targets::TARGETS.into_iter().find(|(known, _)| *known == name).expect("a target");
    let corpus = corpus(name);
    corpus.iter().for_each(|input| target(input));
    let mut random = Rng::with_seed(1);
    for number in 0..ROUNDS {
        let input = if number % 4 == 0 {
            let len = random.usize(..400);
            (0..len).map(|_| random.u8(..)).collect()
        } else {
            mutated(&mut random, &corpus)
        };
        if let Err(panic) = std::panic::catch_unwind(|| target(&input)) {
            eprintln!("{name}, input {number}: {input:02x?}");
            std::panic::resume_unwind(panic);
        }
    }
}

#[test]
fn framer() {
    run("framer");
}

#[test]
fn replies() {
    run("replies");
}

#[test]
fn session() {
    run("session");
}

#[test]
fn configuration() {
    run("configuration");
}

#[test]
fn processors() {
    run("processors");
}

#[test]
fn surroundings() {
    run("surroundings");
}

#[test]
fn lan() {
    run("lan");
}

#[test]
fn recording() {
    run("recording");
}

/// Inputs beside those of the corpus, for each target.
const ROUNDS: u32 = 4_000;
/// Bytes of the longest one.
const MOST: usize = 4_096;
