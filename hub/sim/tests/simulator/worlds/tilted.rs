//! What a tilted sensor measures, against the geometry of what stands there.

use scanhub_schema::{Nanos, Scan, ScanHead};
use scanhub_sim::beam::NoiseModel;
use scanhub_sim::mount::Mount;
use scanhub_sim::room::BeamTarget;
use scanhub_sim::room::Room;
use scanhub_sim::world::World;

use super::{look, text, world};

const SECOND: Nanos = 1_000_000_000;
/// Beams as thin as lines, each at its own time.
const THIN: NoiseModel = NoiseModel { comb: true, ..NoiseModel::NONE };

/// The world with one sensor 1 m high that swings from 0 to 40 degrees, and `things`.
fn tilted(things: &str) -> World {
    let mount = "[sensor.mount]\nheight_mm = 1000\nfrom_deg = 0\nto_deg = 40\ndeg_s = 20\n";
    world(&format!("[[sensor]]\npose = [0, 0, 90]\n{mount}\n{things}")).with_noise(THIN)
}

fn mount(world: &World) -> &Mount {
    world.mount(0).expect("its sensor has a mount")
}

/// Where each beam with a range ends that ended at `end_ns`, in the frame of the mount's axis on the floor: to the right,
/// ahead, up. By the angle at the beam's own time.
fn points(world: &World, end_ns: Nanos) -> Vec<(usize, [f64; 3], BeamTarget)> {
    let scan = look(&Room::new(world, 1), end_ns);
    let head = ScanHead::lms(361, -90_000, 500, 1, 13);
    let times = Scan::of(head, &[0; 361]);
    let point = |beam: usize| {
        let range = f64::from(scan.words[beam] & 0x1FFF);
        let down = mount(world).angle_rad(end_ns.saturating_add_signed(times.beam_ns(beam)));
        let (left, ahead) = times.angle(beam).sin_cos();
        [-left * range, ahead * range * down.cos(), 1000.0 - ahead * range * down.sin()]
    };
    let valid = (0..361).filter(|&beam| scan.truth[beam] != BeamTarget::Invalid);
    valid.map(|beam| (beam, point(beam), scan.truth[beam])).collect()
}

#[test]
fn the_floor_is_at_nought_at_each_beams_own_time() {
    let bare = tilted("");
    let mut met = 0;
    for tenth in 8..80 {
        for (beam, [_, _, up], _) in points(&bare, tenth * SECOND / 10) {
            assert!(up.abs() < 1.0, "beam {beam} at {tenth}: {up} mm");
            met += 1;
        }
    }
    assert!(met > 10_000, "{met}");
}

#[test]
fn things_end_at_their_height_and_a_board_has_room_below() {
    let all = |things: &str| {
        let world = tilted(things);
        (0..160).flat_map(|tenth| points(&world, 3 * SECOND + tenth * SECOND / 40)).collect::<Vec<_>>()
    };
    let on_it = |points: &[(usize, [f64; 3], BeamTarget)], from: f64, until: f64| {
        let within = |p: &[f64; 3]| p[0].abs() < 290.0 && (1400.0..2000.0).contains(&p[1]);
        points.iter().filter(|(_, p, _)| within(p) && (from..until).contains(&p[2])).count()
    };
    let crate_points = all("[[thing]]\nbox = [600, 400]\nheight_mm = 500\npose = [0, 1700]");
    assert!(on_it(&crate_points, 5.0, 490.0) > 300, "its front");
    assert!(on_it(&crate_points, 499.0, 501.0) > 300, "its lid");
    assert_eq!(on_it(&crate_points, 502.0, 2000.0) + on_it(&crate_points, -9.0, -2.0), 0);
    let board = all("[[thing]]\nbox = [600, 400]\nabove_mm = 450\nheight_mm = 500\npose = [0, 1700]");
    assert_eq!(on_it(&board, 5.0, 445.0), 0, "below it is nothing");
    assert!(on_it(&board, -1.0, 1.0) > 50, "but the floor");
}

#[test]
fn what_is_put_down_and_who_walks_is_known() {
    let world: World = "tilt".parse().expect("built in");
    let world = world.with_noise(THIN);
    let count = |second: Nanos, is: &dyn Fn(&BeamTarget) -> bool| {
        let room = Room::new(&world, 1);
        let scans = (0..80).map(|i| look(&room, second * SECOND + i * 26_640_000));
        scans.flat_map(|scan| scan.truth).filter(|met| is(met)).count()
    };
    let is_person = |met: &BeamTarget| *met == BeamTarget::Person;
    let is_box = |met: &BeamTarget| matches!(met, BeamTarget::Box { .. });
    assert_eq!((count(10, &is_person), count(10, &is_box)), (0, 0));
    assert!(count(40, &is_person) > 100);
    assert!(count(40, &is_box) > 300);
}

#[test]
fn a_mount_that_cannot_be_is_refused_by_name_and_place() {
    let refused = |mount: &str| {
        let text = format!("[[sensor]]\npose = [0, 0]\n[sensor.mount]\nheight_mm = 900\n{mount}\n");
        World::of_toml("w.toml", &text).expect_err("it is none").to_string()
    };
    assert!(refused("from_deg = 10\nto_deg = 10").contains("from 10 to 10 degrees"));
    assert!(
        refused("from_deg = 0\nto_deg = 30\nfaults = [{ kind = \"sleeps\" }]").contains("kind = \"sleeps\"")
    );
    assert!(refused("from_deg = 0\nto_deg = 90").contains("w.toml:6"));
    let low = "[[thing]]\nradius_mm = 10\nabove_mm = 300\nheight_mm = 200\n";
    let failure = World::of_toml("w.toml", low).expect_err("upside down");
    assert!(failure.to_string().contains("above_mm = 300"), "{failure}");
}

#[test]
fn without_a_mount_heights_change_nothing() {
    let low = text("fig8").replace("[[thing]]", "[[thing]]\nheight_mm = 10");
    let of = |text: &str| look(&Room::new(&world(text), 3), 20 * SECOND);
    assert_eq!(of(&low), of(&text("fig8")));
}
