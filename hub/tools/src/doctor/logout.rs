//! Whether the hub's shared memory survives the logout of its user: logind removes what an ordinary user has in /dev/shm
//! with the last session, even while a hub uses it (logind.conf(5), RemoveIPC=).

use schema::regular;

use super::finding::Finding;
use super::system::System;

const NAME: &str = "logout";

/// Judges it for the hub of `user`.
pub(crate) fn logout(system: &System, user: u32) -> Finding {
    let name = system.name_of(user);
    if user <= LAST_SYSTEM_USER {
        return Finding::ok(NAME, format!("user {name} is a system user: shared memory stays at logout"));
    }
    if !system.path("run/systemd/users").is_dir() {
        return Finding::ok(NAME, "there is no logind that could remove shared memory");
    }
    let (removes, place) = removes_ipc(system);
    if !removes {
        return Finding::ok(NAME, format!("RemoveIPC=no in {place}: shared memory stays"));
    }
    if system.path("var/lib/systemd/linger").join(&name).exists() {
        return Finding::ok(NAME, format!("user {name} lingers: shared memory stays"));
    }
    Finding::warning(
        NAME,
        format!(
            "RemoveIPC=yes ({place}): when user {name} logs out, shared memory is removed, even while a hub uses it"
        ),
        format!(
            "sudo loginctl enable-linger {name}; or run the service, whose user does not log out; or set RemoveIPC=no under \
             [Login] in /etc/systemd/logind.conf.d/scanhub.conf, then restart the machine"
        ),
    )
}

/// What logind does, and where that is said.
fn removes_ipc(system: &System) -> (bool, String) {
    let directories = PLACES.map(|place| format!("{place}/logind.conf.d"));
    let first = system.first(&PLACES, "logind.conf");
    let files = first.into_iter().chain(system.drop_ins(&directories));
    let mut found = (true, "the default".to_owned());
    for path in files {
        let text = regular::read_text(&path, regular::LONGEST).unwrap_or_default();
        if let Some(said) = said(&text) {
            found = (said, path.display().to_string());
        }
    }
    found
}

/// The last word of a file about it.
fn said(text: &str) -> Option<bool> {
    let mut section = "";
    let mut said = None;
    for line in text.lines().map(str::trim) {
        if line.starts_with('[') {
            section = line;
        } else if let Some((key, value)) = line.split_once('=')
            && (section, key.trim_end()) == ("[Login]", "RemoveIPC")
        {
            said = as_bool(value.trim_start()).or(said);
        }
    }
    said
}

/// As systemd reads it; what it does not understand it passes over.
fn as_bool(value: &str) -> Option<bool> {
    match value.to_lowercase().as_str() {
        "1" | "yes" | "y" | "true" | "t" | "on" => Some(true),
        "0" | "no" | "n" | "false" | "f" | "off" => Some(false),
        _ => None,
    }
}

/// Where systemd looks, in its order.
const PLACES: [&str; 4] = ["etc/systemd", "run/systemd", "usr/local/lib/systemd", "usr/lib/systemd"];
/// Those up to this one are not ordinary users (systemd, SYSTEM_UID_MAX).
const LAST_SYSTEM_USER: u32 = 999;

#[cfg(test)]
mod tests {
    use super::super::finding::State;
    use super::super::system::tests::Laid;
    use super::*;

    #[test]
    fn the_last_file_that_says_it_wins() {
        let laid = Laid::out(1000, &[("etc/passwd", "robot:x:1000:1000::/:\n")]);
        let state = |user| logout(&laid.system, user).state;
        assert_eq!(state(1000), State::Ok, "no logind");
        std::fs::create_dir_all(laid.path("run/systemd/users")).unwrap();
        let finding = logout(&laid.system, 1000);
        assert_eq!(finding.state, State::Warning);
        assert!(finding.remedy.contains("loginctl enable-linger robot"), "{finding}");
        assert_eq!([state(0), state(999), state(1001)], [State::Ok, State::Ok, State::Warning]);
        for (path, content, expected) in [
            ("usr/lib/systemd/logind.conf", "[Login]\nRemoveIPC=no\n", State::Ok),
            ("etc/systemd/logind.conf", "[Login]\n#RemoveIPC=no\nKillUserProcesses=no\n", State::Warning),
            ("usr/lib/systemd/logind.conf.d/50-ipc.conf", "[Login]\nRemoveIPC = off\n", State::Ok),
            ("etc/systemd/logind.conf.d/40-early.conf", "[Login]\nRemoveIPC=yes\n", State::Ok),
            ("run/systemd/logind.conf.d/60-late.conf", "[Login]\nRemoveIPC=true\n", State::Warning),
            ("etc/systemd/logind.conf.d/60-late.conf", "[Other]\nRemoveIPC=true\n", State::Ok),
            (
                "etc/systemd/logind.conf.d/70.conf",
                "[Login]\nRemoveIPC=1\nRemoveIPC=perhaps\n",
                State::Warning,
            ),
            ("var/lib/systemd/linger/robot", "", State::Ok),
        ] {
            laid.put(path, content);
            assert_eq!(state(1000), expected, "{path}");
        }
    }
}
