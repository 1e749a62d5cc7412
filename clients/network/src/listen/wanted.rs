//! Which topics are wanted, and the groups that they come by. Refuses to know who sends them.

use scanhub_schema::datagram::{Announce, group};
use scanhub_schema::{Failure, Kind, Topic};

/// The topics called so; all if none is.
pub(super) fn topics(names: &[String]) -> Result<Vec<Topic>, Failure> {
    if names.is_empty() {
        return Ok(Topic::ALL.to_vec());
    }
    let known: Vec<_> = Topic::ALL.iter().map(|topic| topic.name()).collect();
    let parse = |name: &String| {
        Topic::parse(name).ok_or_else(|| {
            let hint = format!("there are {}; they are those of all sensors", known.join(", "));
            Failure::new(Kind::Usage, format!("no topic {name:?}"), hint)
        })
    };
    names.iter().map(parse).collect()
}

/// The groups of `topics`, and that of announcements, without which nobody has a name.
pub(super) fn groups(topics: &[Topic]) -> Vec<u8> {
    let mut groups = vec![Announce::GROUP];
    groups.extend(topics.iter().map(|&topic| group(topic)));
    groups.sort_unstable();
    groups.dedup();
    groups
}
