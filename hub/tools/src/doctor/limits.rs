//! The limits of a process: descriptors, and the length of files, which must allow the hub's segments.

use config::needs;

use super::finding::Finding;
use super::machine::Facts;

/// Whether the process may open enough.
pub(crate) fn descriptors(facts: &Facts) -> Finding {
    const NAME: &str = "descriptors";
    let Some(limit) = facts.descriptors else { return Finding::ok(NAME, "no limit") };
    let own = facts.open + DESCRIPTORS_AT_START + needs::descriptors(facts.links);
    let remedy = "raise the hard limit: for this shell sudo prlimit --pid $$ --nofile=65536:65536, of a service LimitNOFILE=65536, \
         of a container --ulimit nofile=65536";
    let Some(rest) = limit.checked_sub(own) else {
        let text = format!("{limit} at most, the hub needs {own}");
        return Finding::failed(NAME, text, remedy);
    };
    let consumers = rest / DESCRIPTORS_OF_CONSUMER;
    let text = format!("{limit} at most: enough for about {consumers} consumers of a topic");
    if consumers >= ENOUGH_CONSUMERS { Finding::ok(NAME, text) } else { Finding::warning(NAME, text, remedy) }
}

/// Whether it may make files as long as the longest segment: a longer one than it may ends it by a signal.
pub(crate) fn file_size(facts: &Facts) -> Finding {
    const NAME: &str = "file-size";
    let Some(limit) = facts.file_size else { return Finding::ok(NAME, "no limit") };
    let longest = needs::longest_segment(&facts.limits);
    let text = format!("{} kB at most; the longest segment has {} kB", limit / 1024, longest / 1024);
    if limit >= longest {
        return Finding::ok(NAME, text);
    }
    Finding::failed(NAME, text, "lift the limit: ulimit -f unlimited, LimitFSIZE= of a service")
}

/// What a hub has open when it counts: five for the signals, and its lock.
const DESCRIPTORS_AT_START: u64 = 6;
/// For each consumer of a topic.
const DESCRIPTORS_OF_CONSUMER: u64 = 4;
/// A robot has hardly more.
const ENOUGH_CONSUMERS: u64 = 50;

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::super::machine::tests::{facts, says};
    use super::*;

    #[test]
    fn descriptors_are_counted_in_consumers() {
        says(&descriptors(&facts()), State::Ok, &["4096", "990 consumers"]);
        says(&descriptors(&Facts { descriptors: None, ..facts() }), State::Ok, &["no limit"]);
        says(&descriptors(&Facts { descriptors: Some(152), ..facts() }), State::Warning, &["4 consumers"]);
        says(&descriptors(&Facts { descriptors: Some(131), ..facts() }), State::Failed, &["needs 134"]);
    }

    #[test]
    fn segments_are_files_too() {
        says(&file_size(&facts()), State::Ok, &["no limit"]);
        let of = |limit| file_size(&Facts { file_size: Some(limit), ..facts() });
        says(&of(1 << 30), State::Ok, &["1048576 kB at most"]);
        says(&of(100 << 10), State::Failed, &["100 kB at most", "ulimit -f unlimited", "LimitFSIZE="]);
    }
}
