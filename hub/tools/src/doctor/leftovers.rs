//! What processes left that ended without cleaning up: finds it, and removes it. The next hub does that too, for what it
//! knows to be its own; if no hub starts in that place again, only this removes it.

use std::fs;
use std::os::unix::fs::MetadataExt;

use schema::ipc::{self, Cleaned};
use schema::shortage::SHARED_MEMORY;
use schema::{Domain, Failure, Kind};

use super::finding::Finding;
use super::machine::{Facts, plural};
use super::segments::{self, Segment};

/// Whether something is left.
pub(crate) fn leftovers(facts: &Facts) -> Finding {
    const NAME: &str = "leftovers";
    let nodes = match &facts.nodes {
        Ok(nodes) => nodes,
        Err(failure) => return Finding::failed(NAME, failure.message.clone(), failure.hint.clone()),
    };
    let left = in_words(&facts.segments);
    match (facts.lives(), nodes.dead, nodes.alive) {
        (Some(_), 0, _) => Finding::ok(NAME, "none"),
        (Some(_), dead, _) => {
            Finding::ok(NAME, format!("{} died; the hub is cleaning up", plural(dead as u64, "process")))
        }
        (None, 0, 0) if facts.segments.is_empty() => match &facts.lock {
            None => Finding::ok(NAME, "none"),
            Some(lock) => {
                let text = format!("none but {}, a lock of 16 bytes that the next hub takes", lock.display());
                Finding::ok(NAME, text)
            }
        },
        (None, 0, alive) if alive > 0 => {
            Finding::ok(NAME, format!("none; {} waiting for a hub", plural(alive as u64, "consumer")))
        }
        (None, 0, _) => {
            Finding::warning(NAME, format!("no process holds {left}"), "scanhub doctor --clean removes them")
        }
        (None, dead, _) => Finding::warning(
            NAME,
            format!("{} died without a hub to clean up; {left}", plural(dead as u64, "process")),
            format!(
                "scanhub doctor --clean removes it; so does the next `scanhub run` at {}",
                facts.root.display()
            ),
        ),
    }
}

/// Takes away what dead processes of `user` left in this domain, at all its `places`, and says what. Nothing if a hub or a
/// listener lives at one of them.
pub(crate) fn clean(places: &[&Domain], user: u32) -> Finding {
    const NAME: &str = "clean";
    let Some(prefix) = places.first().map(|place| place.prefix()) else {
        return Finding::ok(NAME, "no domain");
    };
    for place in places {
        if let Ok(Some(pid)) = schema::publisher(place.root()) {
            let why =
                format!("{}: process {pid} publishes there, and cleans up itself", place.root().display());
            return Finding::skipped(NAME, why);
        }
    }
    let before = segments::files(&prefix, user);
    let (mut dead, mut alive) = (0, 0);
    let mut roots = Vec::new();
    for place in places.iter().filter(|place| place.root().metadata().is_ok_and(|it| it.uid() == user)) {
        match ipc::clean(place) {
            Ok(Cleaned { dead: here, alive: others, root }) => {
                dead += here;
                alive += others;
                roots.extend(root.then(|| place.root().display().to_string()));
            }
            // It began between the two looks.
            Err(Failure { kind: Kind::DomainHeld, message, .. }) => return Finding::skipped(NAME, message),
            Err(failure) => return Finding::failed(NAME, failure.message, failure.hint),
        }
    }
    // Consumers that wait for the next hub may be opening them.
    let unheld = if alive == 0 { segments::unheld(&prefix, user) } else { Vec::new() };
    for file in unheld {
        // What cannot be removed is found again.
        let _ = fs::remove_file(&file.path);
    }
    let left = segments::files(&prefix, user);
    let gone: Vec<Segment> = before.into_iter().filter(|file| !left.contains(file)).collect();
    let removed = gone.iter().map(|file| file.path.display().to_string()).chain(roots.iter().cloned());
    removed.for_each(|path| tracing::info!("removed {path}"));
    told(dead, &gone, &roots)
}

fn told(dead: usize, gone: &[Segment], roots: &[String]) -> Finding {
    const NAME: &str = "clean";
    let mut removed = Vec::new();
    if dead > 0 {
        removed.push(format!("what {} left", plural(dead as u64, "process")));
    }
    if !gone.is_empty() {
        removed.push(in_words(gone));
    }
    if !roots.is_empty() {
        removed.push(format!(
            "{} {}",
            if roots.len() == 1 { "directory" } else { "directories" },
            roots.join(", ")
        ));
    }
    match &removed[..] {
        [] => Finding::ok(NAME, "nothing to remove"),
        removed => Finding::ok(NAME, format!("removed {}", removed.join(", "))),
    }
}

fn in_words(files: &[Segment]) -> String {
    let bytes = files.iter().map(|file| file.bytes).sum::<u64>();
    format!("{} ({} kB) in {SHARED_MEMORY}", plural(files.len() as u64, "file"), bytes.div_ceil(1024))
}

#[cfg(test)]
mod tests {
    use schema::ipc::Nodes;

    use super::super::finding::State;
    use super::super::machine::tests::{facts, says};
    use super::*;

    fn segments() -> Vec<Segment> {
        ["/dev/shm/sh_a_1", "/dev/shm/sh_a_2"].map(|path| Segment { path: path.into(), bytes: 1024 }).into()
    }

    #[test]
    fn what_dead_processes_left_is_told_and_waiting_consumers_are_not() {
        says(&leftovers(&facts()), State::Ok, &["none"]);
        let lock = Facts { lock: Some("/dev/shm/sh_a_lock".into()), ..facts() };
        says(&leftovers(&lock), State::Ok, &["none but /dev/shm/sh_a_lock", "16 bytes"]);
        let nodes = |alive, dead| Facts { nodes: Ok(Nodes { alive, dead }), segments: segments(), ..facts() };
        says(&leftovers(&nodes(3, 0)), State::Ok, &["3 consumers waiting"]);
        let words = [
            "1 process died",
            "2 files (2 kB)",
            "doctor --clean",
            "`scanhub run` at /run/user/7/scanhub/scanhub",
        ];
        says(&leftovers(&nodes(0, 1)), State::Warning, &words);
        says(&leftovers(&nodes(0, 0)), State::Warning, &["no process", "2 files", "doctor --clean"]);
        says(&leftovers(&Facts { hub: Ok(Some(5)), ..nodes(3, 2) }), State::Ok, &["2 processes", "cleaning"]);
    }

    #[test]
    fn what_was_removed_is_said() {
        says(&told(0, &[], &[]), State::Ok, &["nothing"]);
        let roots = ["/tmp/a".to_owned()];
        says(
            &told(2, &segments(), &roots),
            State::Ok,
            &["what 2 processes left, 2 files (2 kB)", "directory /tmp/a"],
        );
    }
}
