//! Files of other users under the domain's names in shared memory: none is ever opened, but one that occupies a name which
//! the hub needs prevents its start.

use schema::ipc::Segment;

use super::finding::Finding;

/// Whether there is any; `name_of` tells whose.
pub(crate) fn strangers(found: &[Segment], name_of: impl Fn(u32) -> String) -> Finding {
    const NAME: &str = "strangers";
    if found.is_empty() {
        return Finding::ok(NAME, "no file of another user under the domain's names");
    }
    let each = |segment: &Segment| {
        let (path, owner, mode) = (segment.path.display(), segment.owner, segment.mode);
        format!("{path} of user {owner} ({}), mode {mode:04o}", name_of(owner))
    };
    let paths: Vec<_> = found.iter().map(|segment| segment.path.display().to_string()).collect();
    let told: Vec<_> = found.iter().take(MOST).map(each).collect();
    let more = if found.len() > MOST { format!(" and {} more", found.len() - MOST) } else { String::new() };
    Finding::warning(
        NAME,
        format!("{}{more}: never opened, and may keep hub and clients from creating theirs", told.join(", ")),
        format!("let their owner or an administrator remove them: sudo rm {}", paths[..told.len()].join(" ")),
    )
}

/// Files that are told by name.
const MOST: usize = 4;

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::super::machine::tests::says;
    use super::*;

    #[test]
    fn they_are_told_with_owner_and_remedy() {
        let name_of = |user| format!("u{user}");
        says(&strangers(&[], name_of), State::Ok, &["no file of another user"]);
        let file = |name: &str| Segment::new(name, 7, 0o666, 16);
        let words = ["/dev/shm/sh_a_x", "user 7 (u7), mode 0666", "sudo rm /dev/shm/sh_a_x"];
        says(&strangers(&[file("/dev/shm/sh_a_x")], name_of), State::Warning, &words);
        let many = [file("/a"), file("/b"), file("/c"), file("/d"), file("/e"), file("/f")];
        says(&strangers(&many, name_of), State::Warning, &["/d of", "and 2 more", "sudo rm /a /b /c /d"]);
    }
}
