//! Tests of the tracker from outside: people, doors, ignored areas, recordings of real people, site files, and the site
//! file in docs/tracks.md with its drawing.

mod doors;
mod hall;
#[allow(dead_code)]
#[path = "../../examples/proof/house.rs"]
mod house;
mod ignored;
mod legs;
mod people;
mod site;
#[allow(dead_code)]
#[path = "../../examples/proof/walkers.rs"]
mod walkers;

use scanhub_perception::track::Site;

fn page(name: &str) -> String {
    let path = format!("{}/../../docs/{name}", env!("CARGO_MANIFEST_DIR"));
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

#[test]
fn drawing_on_the_page_matches_its_site_file() {
    let page_text = page("tracks.md");
    let (_, rest) = page_text.split_once("```toml\n").expect("a site file");
    let (text, _) = rest.split_once("```").expect("its end");
    let site = Site::parse("house.toml", text).expect("it is right");
    assert_eq!(site.svg(), page("site.svg"), "drawn by `scanhub site check house.toml --svg docs/site.svg`");
}
