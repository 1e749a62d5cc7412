//! Targets of the fuzzer, which run here without the fuzzer. Their inputs are the corpora, mutations of these inputs,
//! and noise from fixed seeds. `tests/fuzz/README.md` describes how to search for more inputs.

// The module is public because `cargo fuzz` uses the same file as a crate.
#[allow(unreachable_pub)]
#[path = "../fuzz/targets.rs"]
mod targets;

use std::fs;
use std::path::Path;

use fastrand::Rng;

/// Returns the inputs in the corpus of `target`. Each line of the file has the bytes of an input in hexadecimal. If a
/// person wrote the input, a space and its name follow.
fn corpus(target: &str) -> Vec<Vec<u8>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/fuzz/corpus/{target}.txt"));
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let inputs: Vec<Vec<u8>> = text.lines().map(input).collect();
    assert!(!inputs.is_empty(), "the corpus {} is empty", path.display());
    inputs
}

/// Returns the bytes of one line of a corpus.
fn input(line: &str) -> Vec<u8> {
    let hex = line.split(' ').next().unwrap_or_default().as_bytes();
    let (pairs, rest) = hex.as_chunks::<2>();
    assert!(rest.is_empty() && !pairs.is_empty(), "not an input in hex: {line}");
    let digit = |byte: u8| char::from(byte).to_digit(16).unwrap_or_else(|| panic!("not hex: {line}")) as u8;
    pairs.iter().map(|&[high, low]| digit(high) << 4 | digit(low)).collect()
}

/// Returns one input of `corpus` with a few bytes changed, inserted, removed or copied from another input.
fn mutate(random: &mut Rng, corpus: &[Vec<u8>]) -> Vec<u8> {
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
    input.truncate(MAX_INPUT_LEN);
    input
}

fn run(name: &str) {
    let (_, target) = targets::TARGETS.into_iter().find(|(known, _)| *known == name).expect("a target");
    let corpus = corpus(name);
    corpus.iter().for_each(|input| target(input));
    let mut random = Rng::with_seed(1);
    for number in 0..MUTATION_ROUNDS {
        let input = if number % 4 == 0 {
            let len = random.usize(..400);
            (0..len).map(|_| random.u8(..)).collect()
        } else {
            mutate(&mut random, &corpus)
        };
        if let Err(panic) = std::panic::catch_unwind(|| target(&input)) {
            eprintln!("{name}, input {number}: {input:02x?}");
            std::panic::resume_unwind(panic);
        }
    }
}

#[test]
fn fuzzing_framer_finds_no_failure() {
    run("framer");
}

#[test]
fn fuzzing_replies_finds_no_failure() {
    run("replies");
}

#[test]
fn fuzzing_session_finds_no_failure() {
    run("session");
}

#[test]
fn fuzzing_configuration_finds_no_failure() {
    run("configuration");
}

#[test]
fn fuzzing_processors_finds_no_failure() {
    run("processors");
}

#[test]
fn fuzzing_surroundings_finds_no_failure() {
    run("surroundings");
}

#[test]
fn fuzzing_lan_finds_no_failure() {
    run("lan");
}

#[test]
fn fuzzing_recording_finds_no_failure() {
    run("recording");
}

/// Number of mutated inputs for each target.
const MUTATION_ROUNDS: u32 = 4_000;
/// Maximum length of a mutated input, in bytes.
const MAX_INPUT_LEN: usize = 4_096;
