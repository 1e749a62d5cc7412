//! Halls as worlds of the simulator. Each seed has its own furniture, and its own range and speed of the mount. Most
//! tables, shelves and tops are narrower than the distance between two scans.

use std::fmt::Write;

use fastrand::Rng;
use scanhub_sim::world::World;

/// Returns a hall without changes.
pub(crate) fn unchanging(seed: u64) -> World {
    world(&furniture(&mut Rng::with_seed(seed)))
}

/// Returns the hall of [`unchanging`] with objects that appear one after the other from second 30 on, and a person who
/// walks from second 45 on.
pub(crate) fn changing(seed: u64) -> World {
    let mut text = furniture(&mut Rng::with_seed(seed));
    let mut random = Rng::with_seed(1000 + seed);
    for number in 0..4 {
        let (x, y) = (random.i32(-1800..1800), random.i32(1300..4500));
        let shape = match number % 2 {
            0 => format!("radius_mm = {}", random.i32(40..150)),
            _ => format!("box = [{}, {}]", random.i32(200..700), random.i32(200..700)),
        };
        let (height_mm, from_s) = (random.i32(200..1500), 30 + 7 * number);
        let _ = write!(
            text,
            "[[thing]]\n{shape}\nheight_mm = {height_mm}\npose = [{x}, {y}, {}]\nfrom_s = {from_s}\n",
            random.i32(0..90)
        );
    }
    let corners: Vec<String> =
        (0..6).map(|_| format!("[{}, {}]", random.i32(-2500..2500), random.i32(1500..5000))).collect();
    let _ = write!(text, "[[person]]\npath = [{}]\nfrom_s = 45\nuntil_s = 80\n", corners.join(", "));
    world(&text)
}

fn world(text: &str) -> World {
    World::of_toml("hall", text).unwrap_or_else(|failure| panic!("{failure}"))
}

fn furniture(random: &mut Rng) -> String {
    let (from_deg, to_deg) = (-random.i32(5..20), random.i32(30..50));
    let (height_mm, deg_s) = (random.i32(500..1300), 20.0 + 25.0 * random.f64());
    let mut text = format!(
        "[[sensor]]\npose = [0, 0, 90]\n[sensor.mount]\nheight_mm = {height_mm}\narm_mm = [60, 40]\n\
         from_deg = {from_deg}\nto_deg = {to_deg}\ndeg_s = {deg_s}\n[noise]\nbias_mm = 0\n\
         [[thing]]\nline = [[-3500, -2500], [3500, -2500], [3500, 6000], [-3500, 6000], [-3500, -2500]]\n"
    );
    for number in 0..8 {
        let side = if random.bool() { 1 } else { -1 };
        let (x, y) = (side * random.i32(1200..3000), random.i32(1500..5600));
        let heights = match number % 4 {
            // A cupboard or a crate.
            0 => format!("height_mm = {}", random.i32(250..2100)),
            // A table top or shelves.
            _ => {
                let above_mm = random.i32(300..1600);
                format!("above_mm = {above_mm}\nheight_mm = {}", above_mm + random.i32(20..60))
            }
        };
        let (wide, deep) = (random.i32(500..1600), random.i32(300..900));
        let _ = write!(
            text,
            "[[thing]]\nbox = [{wide}, {deep}]\n{heights}\npose = [{x}, {y}, {}]\n",
            random.i32(-40..40)
        );
    }
    text
}
