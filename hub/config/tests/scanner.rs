//! Tests of the scanner of a link, and of the keys that determine the scanner. A key or value that the family does not
//! support is rejected with its position, the value and a remedy.

use scanhub_config::{Config, Link, Sources};
use scanhub_drivers::{Settings, features};
use scanhub_schema::{Family, Kind};

fn load(set: &[&str]) -> Result<Config, String> {
    let sources = Sources {
        files: Vec::new(),
        set: set.iter().map(|flag| (*flag).to_owned()).collect(),
        links: ["front=/dev/ttyUSB0", "rear=/dev/ttyUSB1"].map(str::to_owned).into(),
    };
    Config::load(&sources).map_err(|failure| {
        assert_eq!(failure.kind, Kind::Configuration);
        failure.to_string()
    })
}

/// Family, model and beams of a rotating scanner.
fn scanner_settings(link: &Link) -> Option<(&'static str, &'static str, Option<usize>)> {
    let scanner = &link.scanner;
    let family = scanner.family.filter(|family| *family != Family::Lms)?;
    Some((family.name(), scanner.model().name, scanner.settings.beams))
}

#[test]
fn family_determines_rate_beams_and_valid_settings() {
    let front = |set: &[&str]| load(set).map(|mut config| config.links.swap_remove(0));
    let known = |link: &Link| (scanner_settings(link), link.rate(), link.max_beams());
    let family = "link.front.family=ld";
    let set = |model, beams| Some(("ld", model, beams));
    for (setting, scanner, rate, beams) in [
        (&["link.front.family=lms"][..], None, 500_000, 401),
        (&["link.front.family=lms", "link.front.model=auto"], None, 500_000, 401),
        (&[family, "link.front.model=ld19"], set("ld19", None), 230_400, 450),
        (&[family, "link.front.model=stl27l"], set("stl27l", None), 921_600, 2160),
        (
            &[family, "link.front.model=ld14p", "link.front.beams=8192"],
            set("ld14p", Some(8192)),
            230_400,
            8192,
        ),
        (&[family, "link.front.beams=2"], set("auto", Some(2)), 230_400, 2),
        // A model implies its family.
        (&["link.front.model=LD19"], set("ld19", None), 230_400, 450),
        (&["link.front.model=s2"], Some(("rplidar", "s2", None)), 1_000_000, 3200),
        // Shared memory has enough space for every model but one. For that model, a status reports the remedy.
        (&[family, "link.front.model=auto"], set("auto", None), 230_400, 720),
        // A link may set the defaults explicitly.
        (&[family, "link.front.mode=auto", "link.front.idle=run"], set("auto", None), 230_400, 720),
        // The later key takes precedence, even if it belongs to another family.
        (&[family, "link.front.mode=1", "link.front.mode=auto"], set("auto", None), 230_400, 720),
        (&["link.front.family=lms", "link.front.mode=auto", "link.front.idle=run"], None, 500_000, 401),
    ] {
        let link = front(setting).unwrap();
        assert_eq!(known(&link), (scanner, rate, beams), "{setting:?}");
    }
    // A key for all links applies to the links that support it.
    let config =
        load(&[family, "marks.level=240", "marks.min_level=2", "link.front.marks.level=250"]).unwrap();
    let marks = |link: &Link| (link.processing.marks.min_level, link.processing.marks.level);
    assert_eq!((marks(&config.links[0]), marks(&config.links[1])), ((2, Some(250)), (2, Some(240))));
    // The other link is unchanged.
    assert_eq!(load(&[family]).unwrap().links[1].family(), None);

    let lms = "is a setting of family lms; no other family has it\n  leave it out, or set family = \"lms\"";
    for (others, setting, words) in [
        (&[][..], "family=sick", "family = \"sick\"\n  auto, or one of: lms, ld, rplidar"),
        (&[], "famly=ld", "unknown key `famly`\n  did you mean `family`?"),
        (
            &[],
            "model=ld18",
            "link front: model = \"ld18\"\n  auto, or one of: ld06, ld19, stl19p, stl27l, ld14p, a1, a2m8, a2m12, a3, s1, \
             s2, s3, c1; leave it out for an LMS, which reports its model; `type`",
        ),
        (
            &["link.front.family=lms"],
            "model=lms291",
            "link front: model = \"lms291\", but a scanner of family lms reports its model\n  leave it out; `type`",
        ),
        (
            &["link.front.family=lms"],
            "model=ld19",
            "link front: model = \"ld19\" belongs to family ld, but --set link.front.family=lms sets lms\n  leave `family` \
             out, or set family = \"ld\"",
        ),
        (
            &[family],
            "model=s2",
            "link front: model = \"s2\" belongs to family rplidar, but --set link.front.family=ld sets ld\n  leave `family` \
             out, or set family = \"rplidar\"",
        ),
        (
            &["link.front.family=lms"],
            "beams=450",
            "link front: beams = 450, and an lms has its own\n  leave it out; `angle` and `resolution`",
        ),
        (&[], "beams=1", "beams = 1\n  a whole number from 2 to 8192"),
        (&[family], "beams=8193", "beams = 8193\n  a whole number from 2 to 8192"),
        (&[family], "beams=-450", "beams = -450\n  a whole number"),
        (
            &[family],
            "model=LD18",
            "link front: model = \"LD18\"\n  auto, or one of: ld06, ld19, stl19p, stl27l, ld14p",
        ),
        (&[family], "type=lms200", &format!("link front: type {lms}")),
        (&[family], "angle=180", &format!("link front: angle {lms}")),
        (&[family], "resolution=1", &format!("link front: resolution {lms}")),
        (&[family], "unit=mm", &format!("link front: unit {lms}")),
        (&[family], "mode=0x01", &format!("link front: mode {lms}")),
        (
            &[family],
            "mode=express",
            "link front: mode = \"express\", but an ld has only one scan mode\n  leave it out",
        ),
        (
            &["link.front.family=lms"],
            "mode=express",
            "link front: mode = \"express\"\n  0x00 to 0x06, or 0x0F",
        ),
        (&[], "mode=1.5", "mode = 1.5\n  0x00 to 0x06, or 0x0F"),
        (&[], "mode=nan", "mode = nan\n  0x00 to 0x06, or 0x0F"),
        (&[], "angle=nan", "angle = NaN\n  100 or 180"),
        (
            &[family],
            "idle=stop",
            "link front: idle = \"stop\", but the motor of an ld cannot be stopped\n  leave it out",
        ),
        (
            &["link.front.family=lms"],
            "idle=stop",
            "link front: idle = \"stop\", but the motor of an lms cannot be stopped",
        ),
        (&[family], "idle=rest", "idle = \"rest\"\n  one of: run, stop"),
        (
            &[family],
            "marks.min_level=2",
            "min_level, but the intensities of an ld are not reflector levels\n  use level, the lowest intensity of a reflector",
        ),
        (
            &[family],
            "baud=38400",
            "link front: baud is a setting of family lms; no other family has it\n  \
             leave it out: the rate is the model's",
        ),
    ] {
        let setting = format!("link.front.{setting}");
        let refusal = front(&[others, &[setting.as_str()]].concat()).expect_err(&setting);
        assert!(refusal.starts_with(&format!("--set {setting}: ")), "{refusal}");
        assert!(refusal.contains(words), "{setting}: {refusal}");
    }
}

#[test]
fn every_model_belongs_to_one_family() {
    let features = Family::ALL.into_iter().map(features);
    let mut names: Vec<_> = features.flat_map(|features| features.models).map(|model| model.name).collect();
    let count = names.len();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), count, "{names:?}");
}

#[test]
fn mode_and_idle_are_refused_for_other_families() {
    let family = "link.front.family=rplidar";
    let front = |set: &[&str]| load(&[&[family], set].concat()).map(|mut config| config.links.swap_remove(0));
    let set = |set: &[&str]| {
        let scanner = front(set).unwrap().scanner;
        let Settings { mode, stop_when_idle, .. } = scanner.settings;
        (scanner.model().name, mode, stop_when_idle)
    };
    assert_eq!(set(&[]), ("auto", None, false));
    let settings = ["link.front.model=s2", "link.front.mode=denseboost", "link.front.idle=stop"];
    assert_eq!(set(&settings), ("s2", Some("denseboost"), true));
    let uppercase = ["link.front.model=S2", "link.front.mode=DenseBoost", "link.front.idle=stop"];
    assert_eq!(set(&uppercase), set(&settings));
    assert_eq!(set(&["link.front.model=Auto"]).0, "auto");
    let link = front(&settings).unwrap();
    assert_eq!((link.rate(), link.max_beams()), (1_000_000, 3200));
    // The later source takes precedence, even over the number of an LMS mode.
    assert_eq!(set(&["link.front.mode=1", "link.front.mode=express"]), ("auto", Some("express"), false));
    for (setting, words) in [
        ("mode=fast", "link front: mode = \"fast\"\n  auto, or one of: standard, express, boost"),
        ("mode=1", "link front: mode is a setting of family lms"),
        ("mode=1", "\n  name one of: standard, express"),
        ("baud=38400", "\n  leave it out: the rate is the model's"),
        ("model=a4", "link front: model = \"a4\"\n  auto, or one of: a1, a2m8, a2m12, a3, s1, s2, s3, c1"),
    ] {
        let setting = format!("link.front.{setting}");
        let refusal = front(&[&setting]).expect_err(&setting);
        assert!(refusal.starts_with(&format!("--set {setting}: ")) && refusal.contains(words), "{refusal}");
    }
}

#[test]
fn keys_of_a_link_may_follow_its_port() {
    let load = |link: &str| {
        let sources = Sources { files: Vec::new(), set: Vec::new(), links: vec![link.to_owned()] };
        Config::load(&sources)
            .map(|mut config| config.links.swap_remove(0))
            .map_err(|failure| failure.to_string())
    };
    let link = load("side=/dev/ttyUSB2,family=ld,model=ld19,beams=300").unwrap();
    assert_eq!((link.name.as_str(), link.port.name().as_str()), ("side", "/dev/ttyUSB2"));
    assert_eq!(scanner_settings(&link), Some(("ld", "ld19", Some(300))));
    assert_eq!(load("a=tcp:10.0.0.7:4001,angle=100,unit=cm").unwrap().scanner.settings.view, Some((100, 50)));
    // The name of a port may contain a comma.
    assert_eq!(load("a=file:/tmp/a,b.bin").unwrap().port.name(), "file:/tmp/a,b.bin");
    for (link, words) in [
        ("a=/dev/x,famly=ld", "--link a=/dev/x,famly=ld: unknown key `famly`\n  did you mean `family`?"),
        ("a=/dev/x,family=sick", "--link a=/dev/x,family=sick: family = \"sick\""),
    ] {
        let refusal = load(link).unwrap_err();
        assert!(refusal.contains(words), "{refusal}");
    }
    assert_eq!(load("a=family=ld").unwrap().port.name(), "family=ld", "a port has to be there");
}

#[test]
fn auto_family_has_limits_for_every_family() {
    let front = |set: &[&str]| load(set).map(|mut config| config.links.swap_remove(0));
    let link = front(&[]).unwrap();
    assert_eq!(front(&["link.front.family=auto"]).unwrap(), link, "it is the default");
    assert_eq!((link.family(), link.max_beams(), link.rate()), (None, 3_240, 230_400));
    assert!(link.scanner.is_auto());
    let limits = link.limits(&scanhub_schema::limits::TopicLimits::default());
    for family in Family::ALL.into_iter().map(features) {
        assert!(family.models.iter().all(|model| model.beams <= limits.beams));
        assert!(
            family.max_telegram <= limits.telegram
                && limits.contents & family.array_flags == family.array_flags
        );
    }
    // Keys that every link has, and automatic values, do not determine the family.
    for set in [&["link.front.model=auto", "link.front.mode=Auto"][..], &["link.front.marks.level=200"]] {
        assert_eq!(front(set).unwrap().family(), None, "{set:?}");
    }
    let remedy = "family = \"auto\" needs the most: set link.front.family to one of lms, ld, rplidar";
    let short =
        || scanhub_schema::Failure::new(Kind::ResourceExhausted, "shared memory is short", "free some of it");
    assert_eq!(load(&[]).unwrap().with_remedy(short()).hint, format!("free some of it; {remedy}"));
    let named = load(&["link.front.family=ld", "link.rear.family=lms"]).unwrap();
    assert_eq!(named.with_remedy(short()), short());
    // An LMS has its own number of beams, which is greater than 300.
    let beams = front(&["link.front.beams=300"]).unwrap();
    assert_eq!((beams.scanner.settings.beams, beams.max_beams()), (Some(300), 401));
    for (set, family) in [
        ("type=LMS291", Family::Lms),
        ("angle=100", Family::Lms),
        ("resolution=1", Family::Lms),
        ("unit=mm", Family::Lms),
        ("baud=38400", Family::Lms),
        ("mode=express", Family::Rplidar),
        ("idle=run", Family::Rplidar),
        ("model=LD19", Family::Ld),
        ("model=s2", Family::Rplidar),
        ("family=LD", Family::Ld),
    ] {
        let key = set.split('=').next().unwrap();
        let set = format!("link.front.{set}");
        let link = front(&[&set]).unwrap();
        assert_eq!((link.family(), &link.scanner.named_by[..]), (Some(family), &[key][..]), "{set}");
    }
    let link = front(&["link.front.family=lms", "link.front.type=lms291", "link.front.baud=38400"]).unwrap();
    assert_eq!(link.scanner.named_by, ["family", "type", "baud"]);
    assert_eq!(front(&["link.front.family=AUTO"]).unwrap().family(), None);
    for (first, second, words) in [
        (
            "angle=180",
            "model=ld19",
            "model = \"ld19\" belongs to family ld, but angle at --set link.front.angle=180 belongs to family lms",
        ),
        (
            "model=ld19",
            "idle=stop",
            "idle belongs to family rplidar, but model = \"ld19\" at --set link.front.model=ld19",
        ),
        (
            "baud=38400",
            "mode=boost",
            "mode = \"boost\" belongs to family rplidar, but baud at --set link.front.baud=38400",
        ),
    ] {
        let [first, second] = [first, second].map(|set| format!("link.front.{set}"));
        let refusal = front(&[&first, &second]).unwrap_err();
        assert!(refusal.starts_with(&format!("--set {second}: link front: ")), "{refusal}");
        assert!(refusal.contains(words), "{refusal}");
    }
    let refusal = front(&["link.front.model=ld18"]).unwrap_err();
    assert!(refusal.contains("model = \"ld18\"\n  auto, or one of: ld06"), "{refusal}");
}
