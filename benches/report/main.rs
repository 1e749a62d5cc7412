//! Writes the tables of benches/README.md from benches/last, where `benches/run` keeps the lines of every bench's last run.
//! `-- --criterion DIR BENCH` prints what criterion wrote below DIR as such lines. Refuses to measure anything.

mod criterion;
mod tables;

use std::fs::{read_dir, read_to_string, write};
use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| word != "--bench").collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let outcome = match words[..] {
        [] => report(Path::new(BENCHES)),
        ["--criterion", directory, bench] => criterion::lines(bench, Path::new(directory))
            .map(|lines| lines.iter().for_each(|line| println!("{line}"))),
        _ => Err(format!("{words:?}? nothing, or --criterion DIR BENCH")),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn report(benches: &Path) -> Result<(), String> {
    let (page, last) = (benches.join("README.md"), benches.join("last"));
    let read = |path: &Path| read_to_string(path).map_err(|error| of(path, &error));
    let mut files = Vec::new();
    for entry in read_dir(&last).map_err(|error| of(&last, &error))? {
        let path = entry.map_err(|error| of(&last, &error))?.path();
        if path.extension().is_some_and(|ending| ending == "jsonl") {
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            files.push((name, read(&path)?));
        }
    }
    files.sort();
    let files: Vec<(&str, &str)> =
        files.iter().map(|(name, lines)| (name.as_str(), lines.as_str())).collect();
    let text = tables::page(&read(&page)?, &files)?;
    write(&page, text).map_err(|error| of(&page, &error))?;
    println!("{}: tables of {} benches", page.display(), files.len());
    Ok(())
}

fn of(path: &Path, error: &std::io::Error) -> String {
    format!("{}: {error}; `benches/run` makes what is missing", path.display())
}

/// Where benches are.
const BENCHES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/benches");
