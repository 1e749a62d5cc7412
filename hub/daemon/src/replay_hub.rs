//! A hub that plays a recording. This module finds the sensors in the recording, loads their configuration from the
//! sources that the user named, and creates one player for all links. `reader.rs` uses the same sensors and
//! configuration without a hub.

use std::path::Path;
use std::sync::Arc;

use scanhub_config::{Config, Sources};
use scanhub_drivers::Model;
use scanhub_port::PortSpec;
use scanhub_recording::Recording;
use scanhub_schema::{Failure, Family, Kind, Nanos, check_sensor};
use scanhub_shm::Domain;

use crate::player::{PlaybackOptions, Player, Progress};
use crate::replay::{Origin, RecordedMount, RecordedSensor, log_damage};
use crate::supervise::{self, ReplaySet, StartReport};

/// Options of a replay.
#[derive(Clone, Debug)]
pub struct Replay<'a> {
    /// The recording.
    pub file: &'a Path,
    /// Name of the only sensor to play, without mounts; `None` for all sensors. If the recording has no sensor names,
    /// its sensor gets this name.
    pub sensor: Option<&'a str>,
    /// Family of a stream file; `None` if the hub recognizes the family from the bytes.
    pub family: Option<Family>,
    /// Sources of the configuration: files and flags. The recording itself has only a sensor's family, model, mode and
    /// number of beams.
    pub sources: &'a Sources,
    /// Options of the player.
    pub options: PlaybackOptions,
    /// Whether the hub continues after everything was played.
    pub holds: bool,
}

/// Runs a hub in `domain` that plays a recording, until everything was played and the subscribers had time to read it,
/// or until SIGINT or SIGTERM. `on_ready` is called once, when all topics exist, before the first telegram. Returns
/// the progress at the end.
///
/// # Errors
///
/// Returns [`Kind::Input`] if the recording cannot be read, [`Kind::NoTopic`] if the recording does not contain the
/// sensor, [`Kind::Usage`] if the recording ends before the requested start, and [`Kind::Configuration`] if the
/// recording contradicts the configuration. Also returns the errors of [`run`](crate::run).
pub fn replay(
    replay: &Replay<'_>,
    domain: &Domain,
    on_ready: impl FnOnce(&StartReport, &Arc<Player>),
) -> Result<Progress, Failure> {
    let Replay { file, sources, .. } = *replay;
    let recording = Recording::open_as(file, replay.family)?;
    let set = RecordedSet::new(recording, replay.sensor, sources)?;
    let (links, missing_names) =
        (set.config.links.len(), links_without_sensor(sources, &set.sensors, &set.config)?);
    for name in missing_names {
        tracing::info!("{name}: not in the recording, ignored");
    }
    let mounts = match set.origin {
        Some(origin) => mounts(&set.recording, replay.sensor, origin, &set.config)?,
        None => Vec::new(),
    };
    let RecordedSet { sensors, config, parts, .. } = set;
    let length = parts.iter().filter_map(RecordedSensor::length).max();
    let start_ns = replay.options.start_ns;
    if length.is_some_and(|length| start_ns > length) {
        // The length was computed from the wall clock, which may have been set. Read the recording to be sure.
        let mut ends = Vec::with_capacity(links);
        for part in &parts {
            ends.push(part.end()?);
        }
        let end = ends.into_iter().max().unwrap_or(0);
        if start_ns > end {
            return Err(start_after_end(file, start_ns, end));
        }
    }
    let player = Arc::new(Player::new(replay.options, links, length)?.with_mounts(mounts));
    let load = || configuration(sources, &sensors, file);
    let set = ReplaySet { player: &player, parts, holds: replay.holds };
    supervise::serve(&load, config, Some(set), domain, |ready| on_ready(ready, &player))?;
    Ok(player.progress())
}

fn start_after_end(file: &Path, start_ns: Nanos, end_ns: Nanos) -> Failure {
    let [start_s, end_s] = [start_ns, end_ns].map(|ns| ns as f64 / 1e9);
    let message =
        format!("--start {start_s} s is after the end of {}, which lasts {end_s:.3} s", file.display());
    Failure::new(Kind::Usage, message, "it counts from the first telegram")
}

/// Sensors of a recording, with a link for each.
pub(crate) struct RecordedSet {
    pub(crate) recording: Recording,
    sensors: Vec<Sensor>,
    pub(crate) config: Config,
    /// Recording of each link.
    pub(crate) parts: Vec<RecordedSensor>,
    /// Start of the media time; `None` without stamps.
    pub(crate) origin: Option<Origin>,
}

impl RecordedSet {
    /// Creates the links of the sensors in `recording`, or of `sensor` alone, with the configuration in `sources`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`replay`] about the recording, the sensor and the configuration.
    pub(crate) fn new(
        recording: Recording,
        sensor: Option<&str>,
        sources: &Sources,
    ) -> Result<RecordedSet, Failure> {
        log_damage(&recording);
        let sensors = sensors(&recording, sensor)?;
        let config = configuration(sources, &sensors, recording.path())?;
        let mut parts = Vec::with_capacity(config.links.len());
        for link in &config.links {
            let of = sensors.iter().find(|sensor| sensor.link == link.name);
            let part = match of.and_then(|sensor| sensor.recorded.as_deref()) {
                Some(name) => recording.of(name)?,
                None => recording.clone(),
            };
            parts.push(RecordedSensor::new(part, link)?);
        }
        let origin = parts.iter().filter_map(RecordedSensor::origin).reduce(Origin::earlier);
        if let Some(origin) = origin {
            parts.iter_mut().for_each(|part| part.set_origin(origin));
        }
        Ok(RecordedSet { recording, sensors, config, parts, origin })
    }
}

/// Sensor that is played.
struct Sensor {
    /// Name in the recording, if that has names.
    recorded: Option<String>,
    /// Name of its link.
    link: String,
    /// Family of its scanner; `None` if this version does not have it.
    family: Option<Family>,
    /// Model and number of beams of a rotating scanner, as far as the recording has them.
    model: Result<Option<Model>, Failure>,
    beams: Option<usize>,
    /// Name of the measuring mode.
    mode_name: Option<&'static str>,
}

impl Sensor {
    /// Creates the only sensor of `recording`, which `link` plays.
    fn new(recorded: Option<String>, link: String, recording: &Recording) -> Sensor {
        let (model, beams, mode_name) =
            (recording.model(), recording.beams(), recording.contents().mode_name);
        Sensor { recorded, link, family: recording.family(), model, beams, mode_name }
    }
}

fn sensors(recording: &Recording, chosen: Option<&str>) -> Result<Vec<Sensor>, Failure> {
    let names = &recording.contents().sensors;
    if names.is_empty() {
        let link = chosen.unwrap_or(DEFAULT_NAME).to_owned();
        check_sensor(&link).map_err(|failure| Failure { kind: Kind::Usage, ..failure })?;
        return Ok(vec![Sensor::new(None, link, recording)]);
    }
    let chosen = match chosen {
        // The user may also name a remote sensor by its link, because messages use the name of the link.
        Some(chosen) if !names.iter().any(|name| name == chosen) => {
            let recorded = names.iter().find(|name| link_name(name) == chosen);
            Some(recorded.map_or(chosen, String::as_str))
        }
        chosen => chosen,
    };
    if let Some(chosen) = chosen {
        recording.of(chosen)?;
    }
    let played = names.iter().filter(|name| chosen.is_none_or(|chosen| chosen == name.as_str()));
    let sensor = |name: &String| -> Result<Sensor, Failure> {
        Ok(Sensor::new(Some(name.clone()), link_name(name), &recording.of(name)?))
    };
    let sensors: Vec<Sensor> = played.map(sensor).collect::<Result<_, _>>()?;
    for (at, sensor) in sensors.iter().enumerate() {
        check_sensor(&sensor.link)?;
        if sensors[..at].iter().any(|other| other.link == sensor.link) {
            let message = format!("two sensors of the recording would get the name {}", sensor.link);
            return Err(Failure::new(Kind::Usage, message, "play one of them: --sensor NAME"));
        }
    }
    Ok(sensors)
}

/// Returns the mounts of `recording`, under names that no link of `config` has. If the user chose a sensor, no mount is
/// played.
fn mounts(
    recording: &Recording,
    chosen: Option<&str>,
    origin: Origin,
    config: &Config,
) -> Result<Vec<RecordedMount>, Failure> {
    let mut mounts: Vec<RecordedMount> = Vec::new();
    for recorded in recording.mounts() {
        if chosen.is_some() {
            tracing::info!(
                "{recorded}: not played, because --sensor plays only one sensor; replay without --sensor plays it"
            );
            continue;
        }
        let name = link_name(&recorded);
        check_sensor(&name)?;
        let is_taken = config.links.iter().any(|link| link.name == name)
            || mounts.iter().any(|mount| mount.name() == name);
        if is_taken {
            tracing::warn!(
                "the angles of mount {recorded} are not played: a link or another mount has the name {name}"
            );
            continue;
        }
        mounts.push(RecordedMount::new(&recorded, name, recording, origin));
    }
    Ok(mounts)
}

/// Returns a name for the link of `sensor`. The name of a remote sensor has a dot, which a link cannot have.
fn link_name(sensor: &str) -> String {
    let name: String = sensor.chars().map(|c| if c == '.' { '-' } else { c }).collect();
    // Drop the start of a long name. It may be the long ID of a machine without a name, and the sensor's own name is at
    // the end.
    let excess = name.len().saturating_sub(MAX_NAME_LEN);
    name.get(excess..).unwrap_or(&name).to_owned()
}

/// Returns the configuration, with the sensors of the recording as links.
fn configuration(sources: &Sources, sensors: &[Sensor], file: &Path) -> Result<Config, Failure> {
    let (sources, searched) = with_links(sources, sensors)?;
    let mut config = Config::load(&sources)?;
    config.links.retain(|link| sensors.iter().any(|sensor| sensor.link == link.name));
    for link in &mut config.links {
        link.port = PortSpec::File { path: file.to_owned(), paced: true };
        link.scanner.settings.is_found = searched.contains(&link.name);
        let of = sensors.iter().find(|sensor| sensor.link == link.name);
        // The recording supplies the settings that are not configured.
        if let Some(Sensor { model, beams, mode_name, .. }) = of.filter(|_| link.scanner.is_auto()) {
            let settings = &mut link.scanner.settings;
            if settings.mode.is_none() {
                settings.model = model.clone()?.map(|model| model.name);
            }
            settings.mode = settings.mode.or(*mode_name);
            settings.beams = *beams;
        }
    }
    Ok(config)
}

/// Returns `sources` with a link for each of `sensors`, and the names of the links without a configured family. These
/// links get the family of their sensor.
fn with_links(sources: &Sources, sensors: &[Sensor]) -> Result<(Sources, Vec<String>), Failure> {
    let mut sources = sources.clone();
    // The port does not name the real path, because a path may contain characters that have a meaning in the name of a
    // port.
    for sensor in sensors {
        let name = format!("{}=", sensor.link);
        if !sources.links.iter().any(|link| link.starts_with(&name)) {
            sources.links.push(format!("{name}file:recording"));
        }
    }
    let links = Config::load(&sources)?.links;
    let is_searched =
        |sensor: &&Sensor| links.iter().any(|link| link.name == sensor.link && link.family().is_none());
    let searched: Vec<&Sensor> = sensors.iter().filter(is_searched).collect();
    let family = |sensor: &&Sensor| Some(format!("link.{}.family={}", sensor.link, sensor.family?.name()));
    sources.set.extend(searched.iter().filter_map(family));
    Ok((sources, searched.iter().map(|sensor| sensor.link.clone()).collect()))
}

/// Returns the configured links that are not in `config`.
fn links_without_sensor(
    sources: &Sources,
    sensors: &[Sensor],
    config: &Config,
) -> Result<Vec<String>, Failure> {
    if sources.files.is_empty() {
        return Ok(Vec::new());
    }
    let all = Config::load(&with_links(sources, sensors)?.0)?.links.into_iter().map(|link| link.name);
    Ok(all.filter(|name| config.links.iter().all(|link| link.name != *name)).collect())
}

/// Name of the sensor, if the recording has no sensor names.
const DEFAULT_NAME: &str = "front";
/// Maximum length of a sensor's name in bytes.
const MAX_NAME_LEN: usize = 24;

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs::File;

    use scanhub_drivers::lms;
    use scanhub_drivers::lms::variant::Unit;
    use scanhub_schema::file::Writer;
    use scanhub_schema::{Header, Topic};

    use super::*;

    fn sensor(name: &str) -> Sensor {
        Sensor {
            recorded: None,
            link: name.to_owned(),
            family: Some(Family::Lms),
            model: Ok(None),
            beams: None,
            mode_name: None,
        }
    }

    #[test]
    fn recorded_sensors_become_configured_links() {
        let sources = Sources { set: vec!["link.front.angle=100".into()], ..Sources::default() };
        let file = Path::new("/tmp/a?b=c.mcap");
        let config = configuration(&sources, &[sensor("front"), sensor("left")], file).unwrap();
        let named: Vec<_> =
            config.links.iter().map(|link| (link.name.as_str(), link.scanner.settings.view)).collect();
        assert_eq!(named, [("front", Some((100, 50))), ("left", Some((180, 50)))]);
        assert_eq!(config.links[1].port, PortSpec::File { path: file.to_owned(), paced: true });
        let place = tempfile::NamedTempFile::new().unwrap().into_temp_path();
        std::fs::write(&place, "[[link]]\nname = \"rear\"\nport = \"/dev/x\"\nbaud = 38400\n[[link]]\nname = \"up\"\nport = \"y\"\n").unwrap();
        let sources = Sources { files: vec![place.to_path_buf()], ..Sources::default() };
        let config = configuration(&sources, &[sensor("rear")], file).unwrap();
        let missing_names = links_without_sensor(&sources, &[sensor("rear")], &config).unwrap();
        assert_eq!(
            (config.links.len(), config.links[0].rate(), missing_names),
            (1, 38_400, vec!["up".to_owned()])
        );
    }

    #[test]
    fn remote_sensor_is_chosen_by_either_name() {
        let place = tempfile::NamedTempFile::new().unwrap().into_temp_path();
        let mut writer = Writer::begin(File::create(&place).unwrap(), "", BTreeMap::new()).unwrap();
        let telegram = lms::measured::encode(0, Unit::Mm, &[1000; 181], 0x10);
        for name in ["robot1.front", "a.b", "a-b"] {
            writer.write_sample(name, Topic::Telegram, &Header::default(), telegram.bytes()).unwrap();
        }
        writer.finish().unwrap();
        let recording = Recording::open(place.to_path_buf()).unwrap();
        let recorded = |wanted| match &sensors(&recording, Some(wanted)).unwrap()[..] {
            [only] => only.recorded.clone().unwrap(),
            _ => panic!("{wanted}"),
        };
        for (wanted, name) in [
            ("robot1.front", "robot1.front"),
            ("robot1-front", "robot1.front"),
            ("a.b", "a.b"),
            ("a-b", "a-b"),
        ] {
            assert_eq!(recorded(wanted), name);
        }
        assert_eq!(sensors(&recording, Some("front")).err().unwrap().kind, Kind::NoTopic);
    }

    #[test]
    fn remote_sensors_get_valid_link_names() {
        assert_eq!(link_name("robot1.front"), "robot1-front");
        let long = link_name("5f3a12bc00d1e2f3.front_left");
        assert_eq!((long.len(), long.ends_with("-front_left")), (24, true), "{long}");
    }
}
