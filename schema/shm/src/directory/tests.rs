//! Who may open a domain's directory, and by which way.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};

use tempfile::TempDir;

use super::*;

/// `HERE/base/domain`, each with mode 0700.
struct Here(TempDir);

impl Here {
    fn new() -> Here {
        let here = Here(TempDir::new().unwrap());
        Directory::make(&here.at("base/domain")).unwrap();
        here
    }

    fn at(&self, path: &str) -> PathBuf {
        self.0.path().join(path)
    }

    fn mode(&self, path: &str, mode: u32) {
        fs::set_permissions(self.at(path), Permissions::from_mode(mode)).unwrap();
    }
}

fn refusal(opened: Result<Option<Directory>, Failure>) -> String {
    let failure = opened.expect_err("it is refused");
    assert!(!failure.hint.is_empty());
    failure.message
}

#[test]
fn what_is_missing_is_nothing_or_made_for_this_user_alone() {
    let here = Here::new();
    assert!(Directory::open(&here.at("base/domain")).unwrap().is_some());
    for absent in ["base/other", "other/domain", "a/b/c"] {
        assert!(Directory::open(&here.at(absent)).unwrap().is_none(), "{absent}");
    }
    Directory::make(&here.at("a/b/c")).unwrap();
    for made in ["a", "a/b", "a/b/c"] {
        assert_eq!(fs::metadata(here.at(made)).unwrap().permissions().mode() & 0o7777, 0o700, "{made}");
    }
}

#[test]
fn base_and_domain_are_this_users_alone() {
    let here = Here::new();
    let path = here.at("base/domain");
    let own = user();
    let said = refusal(Directory::walk(&path, 2, Purpose::Domain, own + 1, false));
    assert!(said.starts_with(&format!("{} belongs to user {own}", here.at("base").display())), "{said}");
    assert!(said.contains("with mode 0700, this is user"), "{said}");
    for open in ["base", "base/domain"] {
        for mode in [0o720, 0o702, 0o1777] {
            here.mode(open, mode);
            let said = refusal(Directory::open(&path));
            assert!(said.starts_with(&format!("{} has mode {mode:04o}", here.at(open).display())), "{said}");
            let hint = Directory::open(&path).unwrap_err().hint;
            assert_eq!(hint.contains("chmod go-w"), mode & STICKY == 0, "{hint}");
        }
        here.mode(open, 0o755);
    }
    assert!(Directory::open(&path).unwrap().is_some(), "others may look");
}

#[test]
fn links_are_followed_above_the_base_where_nobody_else_makes_them() {
    let here = Here::new();
    symlink(here.at("base"), here.at("link")).unwrap();
    symlink("domain", here.at("base/alias")).unwrap();
    for (path, link) in [("link/domain", "link"), ("base/alias", "base/alias")] {
        let said = refusal(Directory::open(&here.at(path)));
        assert!(said.starts_with(&format!("{} is a link", here.at(link).display())), "{said}");
    }
    Directory::make(&here.at("base/x/domain")).unwrap();
    assert!(Directory::open(&here.at("link/x/domain")).unwrap().is_some());
    here.mode("", 0o1777);
    let said = refusal(Directory::open(&here.at("link/x/domain")));
    assert!(said.contains("is a link of user") && said.contains("mode 1777"), "{said}");
    here.mode("", 0o700);
    // Another user sees root's links followed, and nobody's besides.
    if user() != 0 {
        let said = refusal(Directory::walk(&here.at("link/x/domain"), 2, Purpose::Domain, user() + 1, false));
        assert!(said.contains("is a link of user"), "{said}");
    }
    symlink("circle", here.at("circle")).unwrap();
    assert!(Directory::open(&here.at("circle/x/domain")).is_err());
    fs::write(here.at("file"), "").unwrap();
    assert!(Directory::open(&here.at("file/x/domain")).is_err());
}

#[test]
fn files_are_regular_ones() {
    let here = Here::new();
    let directory = Directory::make(&here.at("base/domain")).unwrap();
    assert!(directory.file("hub.lock").unwrap().is_none());
    directory.file_or_new("hub.lock").unwrap();
    let mode = fs::metadata(here.at("base/domain/hub.lock")).unwrap().permissions().mode();
    assert_eq!(mode & 0o7777, 0o600);
    assert!(directory.file("hub.lock").unwrap().is_some());
    fs::write(here.at("victim"), "whole").unwrap();
    symlink(here.at("victim"), here.at("base/domain/link")).unwrap();
    symlink(here.at("victim"), here.at("base/domain/prefix.new")).unwrap();
    let fifo = here.at("base/domain/fifo");
    rustix::fs::mknodat(rustix::fs::CWD, &fifo, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    for (name, word) in [("link", "is a link"), ("fifo", "is no regular file")] {
        for failure in [directory.file(name).unwrap_err(), directory.file_or_new(name).unwrap_err()] {
            assert!(failure.message.contains(word), "{name}: {failure}");
        }
    }
    directory.replace("prefix", b"x").unwrap();
    assert_eq!(fs::read_to_string(here.at("base/domain/prefix")).unwrap(), "x");
    assert_eq!(fs::read_to_string(here.at("victim")).unwrap(), "whole");
}
