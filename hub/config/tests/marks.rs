//! Tests of the minimum intensity of marks. One key is for reflector levels, and another key is for intensities of any
//! surface. If a key is set for one link alone and does not apply to the link's scanner, the link rejects it.

use scanhub_config::{Config, Link, Sources, values};

fn sources(set: &[&str]) -> Sources {
    let owned = |flags: &[&str]| flags.iter().map(|flag| (*flag).to_owned()).collect();
    let set = [&["link.side.family=ld"], set].concat();
    Sources { files: Vec::new(), links: owned(&["front=/dev/x,family=lms", "side=/dev/y"]), set: owned(&set) }
}

#[test]
fn shared_settings_apply_to_links_that_support_them() {
    let set = ["marks.level=240", "marks.min_level=2", "link.side.marks.level=250"];
    let config = Config::load(&sources(&set)).unwrap();
    let marks = |link: &Link| (link.processing.marks.min_level, link.processing.marks.level);
    assert_eq!((marks(&config.links[0]), marks(&config.links[1])), ((2, Some(240)), (2, Some(250))));
    let values = values(&sources(&set)).unwrap();
    let shown = |key: &str| values.iter().find(|value| value.key == key).map(|value| value.text());
    assert_eq!(shown("link.front.marks.min_level").as_deref(), Some("2"));
    assert_eq!(shown("link.side.marks.level").as_deref(), Some("250"));
    assert_eq!((shown("link.side.marks.min_level"), shown("link.front.marks.level")), (None, None));
    assert_eq!(Config::load(&sources(&[])).unwrap().links[1].processing.marks.level, None, "no default");
}

#[test]
fn refuses_out_of_range_and_unsupported_settings() {
    for (setting, words) in [
        ("marks.level=0", "level = 0\n  a whole number from 1 to 65535"),
        ("marks.level=65536", "level = 65536\n  a whole number from 1 to 65535"),
        (
            "link.front.marks.level=200",
            "level, but the intensities of an lms are reflector levels, 0 to 7\n  use min_level",
        ),
        (
            "link.side.marks.min_level=2",
            "min_level, but the intensities of an ld are not reflector levels\n  use level, the lowest intensity of a reflector",
        ),
        ("early.pieces=1", "pieces = 1\n  a whole number from 2 to 8"),
        (
            "link.side.early.pieces=4",
            "pieces, but an ld sends short packets\n  leave it out: early warnings use every packet",
        ),
    ] {
        let failure = Config::load(&sources(&[setting])).expect_err(setting);
        let refusal = format!("{}\n  {}", failure.message, failure.hint);
        assert!(refusal.starts_with(&format!("--set {setting}: ")) && refusal.contains(words), "{refusal}");
    }
}
