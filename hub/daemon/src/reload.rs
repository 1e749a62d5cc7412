//! Reload of the configuration while the hub runs. Settings of the processors change with the next scan, and no scan is
//! lost. Settings of a line apply only at the next start of the hub, and the log lists them. An invalid configuration
//! changes nothing.

use scanhub_config::{Background, Config, Link, Processing};
use scanhub_schema::{Failure, Nanos};

use crate::control::CommandSender;
use crate::service::Service;

/// Function that reads the configuration.
pub type ConfigLoader<'a> = &'a dyn Fn() -> Result<Config, Failure>;

/// Running configuration of the hub, and the function that loads the new one.
pub struct Reload<'a> {
    running: Config,
    loader: ConfigLoader<'a>,
    service: &'a Service,
}

/// Changes of the configuration, sorted by when they apply.
#[derive(Debug, Default, PartialEq)]
struct Differences {
    /// Settings that apply with the next scan: name of the link, its new settings, and the sections that have changed.
    now: Vec<(String, Processing, Vec<&'static str>)>,
    /// Keys that wait for the next start, by the name of the link.
    later: Vec<(String, Vec<&'static str>)>,
}

impl<'a> Reload<'a> {
    /// Creates the reload of a hub that runs with `running`.
    pub fn new(running: &Config, loader: ConfigLoader<'a>, service: &'a Service) -> Reload<'a> {
        Reload { running: running.clone(), loader, service }
    }

    /// Reads the configuration at `now`, sends the links their new settings through `commands`, and logs the result.
    pub fn reload(&mut self, commands: &CommandSender, now: Nanos) {
        self.service.notify_reloading(now);
        let refused = match (self.loader)() {
            Ok(config) => {
                self.apply(config, commands);
                None
            }
            Err(failure) => {
                tracing::error!(
                    "the configuration is refused, the old one stays: {}; {}",
                    failure.message,
                    failure.hint
                );
                Some(failure.message)
            }
        };
        let sensors: Vec<_> = self.running.links.iter().map(|link| link.name.clone()).collect();
        self.service.notify_ready(&sensors, refused.as_deref());
    }

    fn apply(&mut self, config: Config, commands: &CommandSender) {
        let Differences { now, later } = Differences::between(&self.running, &config);
        if now.is_empty() && later.is_empty() {
            tracing::info!("the configuration has not changed");
        }
        for (name, processing, sections) in now {
            tracing::info!("{name}: {} changed as configured", sections.join(", "));
            commands.change(&name, &processing);
            if let Some(link) = self.running.links.iter_mut().find(|link| link.name == name) {
                link.processing = processing;
            }
        }
        for (name, what) in later {
            tracing::warn!("{name}: {}", postponed(&what));
        }
    }
}

/// Returns the message for changes that a running hub cannot apply. `changes` contains the changed keys of a link, or
/// that the link was added or removed.
fn postponed(changes: &[&str]) -> String {
    let pronoun = if changes.len() == 1 { "it" } else { "them" };
    let what = match changes {
        ["link added" | "link removed"] => changes[0].to_owned(),
        [first @ .., before, last] => {
            let first: String = first.iter().map(|key| format!("{key}, ")).collect();
            format!("{first}{before} and {last} changed")
        }
        keys => format!("{} changed", keys.concat()),
    };
    format!("{what}; restart the hub to apply {pronoun}")
}

impl Differences {
    fn between(running: &Config, loaded: &Config) -> Differences {
        let mut differences = Differences::default();
        let named = |config: &'_ Config, name: &str| config.links.iter().position(|link| link.name == name);
        for old in &running.links {
            match named(loaded, &old.name) {
                Some(at) => differences.of_link(old, &loaded.links[at]),
                None => differences.later.push((old.name.clone(), vec!["link removed"])),
            }
        }
        let added = loaded.links.iter().filter(|link| named(running, &link.name).is_none());
        if running.limits != loaded.limits {
            differences.later.push(("limits".to_owned(), vec!["subscribers"]));
        }
        differences.later.extend(added.map(|link| (link.name.clone(), vec!["link added"])));
        differences
    }

    fn of_link(&mut self, old: &Link, new: &Link) {
        let settings = merged(&old.processing, &new.processing);
        let sections = old.processing.differences(&settings);
        let start = |link: &Link| {
            let background = &link.processing.background;
            (background.learning.start, background.file.clone())
        };
        let has_started = old.processing.background.is_enabled && new.processing.background.is_enabled;
        let mut waiting = old.differences(new);
        if has_started && start(old) != start(new) {
            waiting.push("background.start");
        }
        if !sections.is_empty() {
            self.now.push((old.name.clone(), settings, sections));
        }
        if !waiting.is_empty() {
            self.later.push((old.name.clone(), waiting));
        }
    }
}

/// Returns the settings that a link with `old` settings takes over from `new` ones: all but the start of its
/// background.
fn merged(old: &Processing, new: &Processing) -> Processing {
    let mut settings = new.clone();
    if old.background.is_enabled {
        let Background { learning, file, model, is_start_set, .. } = &old.background;
        settings.background.learning.start = learning.start;
        settings.background.is_start_set = *is_start_set;
        (settings.background.file, settings.background.model) = (file.clone(), model.clone());
    }
    settings
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_config::Sources;
    use scanhub_preprocess::background::Start;

    fn config(links: &[&str], set: &[&str]) -> Config {
        let owned = |flags: &[&str]| flags.iter().map(|flag| (*flag).to_owned()).collect();
        let sources = Sources { files: Vec::new(), links: owned(links), set: owned(set) };
        Config::load(&sources).expect("a configuration")
    }

    #[test]
    fn scanner_settings_apply_at_restart() {
        let of = |set: &[&str]| config(&["a=/dev/x"], set);
        let (lms, auto) = (of(&[]), of(&["link.a.family=ld"]));
        let named = of(&["link.a.family=ld", "link.a.model=ld19", "link.a.beams=300"]);
        for (old, new, what) in
            [(&lms, &auto, "family"), (&auto, &named, "model beams"), (&named, &lms, "family model beams")]
        {
            let Differences { now, later } = Differences::between(old, new);
            let later: Vec<_> = later.iter().map(|(name, what)| (name.as_str(), what.join(" "))).collect();
            assert_eq!((now.len(), later), (0, vec![("a", what.to_owned())]));
        }
    }

    #[test]
    fn processing_applies_at_once_and_links_at_restart() {
        let old = config(&["a=/dev/x", "b=/dev/y,family=lms", "c=/dev/z"], &[]);
        let same = Differences::between(&old, &old);
        assert_eq!(same, Differences::default());
        let new = config(
            &["d=/dev/w", "b=/dev/other,family=lms", "a=/dev/x"],
            &[
                "zones.radii=[2.0]",
                "link.a.pose.x=0.3",
                "link.b.marks.min_level=2",
                "link.b.lines.refine=true",
                "link.b.motion.max_step=0.3",
                "link.b.early.pieces=4",
                "link.b.angle=100",
                "link.b.resolution=0.25",
                "link.b.unit=cm",
                "link.b.baud=38400",
                "link.b.type=lms200",
                "limits.subscribers=33",
            ],
        );
        let Differences { now, later } = Differences::between(&old, &new);
        let now: Vec<_> = now
            .iter()
            .map(|(name, to, sections)| (name.as_str(), &to.zones.radii_mm[..], &sections[..]))
            .collect();
        assert_eq!(
            now,
            [
                ("a", &[2000][..], &["pose", "zones"][..]),
                ("b", &[2000], &["zones", "marks", "lines", "motion", "early"])
            ]
        );
        let later: Vec<_> = later.iter().map(|(name, what)| (name.as_str(), what.join(" "))).collect();
        assert_eq!(
            later,
            [
                ("b", "port type angle resolution unit baud".to_owned()),
                ("c", "link removed".to_owned()),
                ("limits", "subscribers".to_owned()),
                ("d", "link added".to_owned()),
            ]
        );
    }

    #[test]
    fn change_of_background_start_applies_at_restart() {
        let of = |set: &[&str]| config(&["a=/dev/x"], set);
        let begun = of(&["background.start=first-scan"]);
        let other = of(&["background.threshold_mm=50"]);
        let Differences { now, later } = Differences::between(&begun, &other);
        let [(_, taken, sections)] = &now[..] else { panic!("{now:?}") };
        let learning = taken.background.learning;
        assert_eq!((learning.start, learning.threshold_mm), (Start::FirstScan, Some(50)));
        assert_eq!(
            (sections.join(" "), later),
            ("background".to_owned(), vec![("a".to_owned(), vec!["background.start"])])
        );
        // A background that was off takes over the new value of `background.start`.
        let off = of(&["background.method=off", "background.start=first-scan"]);
        let Differences { now, later } = Differences::between(&off, &of(&[]));
        assert_eq!((now[0].1.background.learning.start, later), (Start::Empty, Vec::new()));
    }
}
