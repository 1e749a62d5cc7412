//! The payloads as Rust lays them out, and a program that says how C does: every field of every one, so that nothing lies
//! between two of them.

use std::mem::{offset_of, size_of};

use schema::{
    Background, Counter, Foreground, Header, Mark, Marks, Pose, Scan, Segment, Status, Zone, Zones,
};

struct Layout {
    /// In C.
    name: &'static str,
    size: usize,
    /// Name, offset, size.
    fields: Vec<(&'static str, usize, usize)>,
}

fn size_of_field<T, F>(_: impl Fn(&T) -> &F) -> usize {
    size_of::<F>()
}

macro_rules! layouts {
    ($($name:literal $payload:ty: $($field:ident)*;)*) => {
        vec![$(Layout {
            name: $name,
            size: size_of::<$payload>(),
            fields: vec![$((
                stringify!($field),
                offset_of!($payload, $field),
                size_of_field(|payload: &$payload| &payload.$field),
            ),)*],
        },)*]
    };
}

fn layouts() -> Vec<Layout> {
    let layouts = layouts! {
        "scanhub_header_v1" Header: seq topic_seq stamp_first_ns stamp_last_ns wall_ns boot sensor quality flags
            period_us hub_pid reasons hub_time;
        "scanhub_scan_v1" Scan: count unit_mm range_bits first_angle_mdeg step_mdeg intensity_bits contents
            range_array upper_array pad;
        "scanhub_mark_v1" Mark: angle_mdeg range_dmm weight peak edge first_beam last_beam;
        "scanhub_marks_v1" Marks: count flags reserved mark_array;
        "scanhub_zone_v1" Zone: radius_mm beams violated reserved;
        "scanhub_zones_v1" Zones: verdict count nearest_beam nearest_mm invalid_beams flags reserved zone_array;
        "scanhub_segment_v1" Segment: first last nearest width x_mm y_mm;
        "scanhub_foreground_v1" Foreground: generation count beams unit_mm left_out segments bit_array pad
            range_array pad2 segment_array;
        "scanhub_background_v1" Background: generation taught count unit_mm flags reserved range_array pad;
        "scanhub_pose_v1" Pose: x_m y_m yaw_rad upside_down reserved;
        "scanhub_status_v1" Status: state mode unit_mm reserved baud since_ns rate_mhz angle_deg resolution_cdeg
            type_text port_text last_error_text counters pose;
    };
    for layout in &layouts {
        let mut end = 0;
        for (field, offset, size) in &layout.fields {
            assert_eq!(*offset, end, "{} has something before {field}", layout.name);
            end = offset + size;
        }
        assert_eq!(end, layout.size, "{} has something at its end", layout.name);
    }
    layouts
}

/// What [`program`] should say.
pub(crate) fn expected() -> Vec<String> {
    let mut lines = Vec::new();
    for Layout { name, size, fields } in layouts() {
        lines.push(format!("{name} {size}"));
        let line = |(field, offset, size)| format!("{name}.{field} {offset} {size}");
        lines.extend(fields.into_iter().map(line));
    }
    lines.extend(Counter::ALL.iter().map(|counter| format!("{} {}", counter.name(), *counter as usize)));
    lines
}

/// A program in C and C++ that says how it lays the payloads out.
pub(crate) fn program() -> String {
    let mut says = String::new();
    for Layout { name, fields, .. } in layouts() {
        says += &format!("printf(\"{name} %u\\n\", (unsigned)sizeof(struct {name}));\n");
        for (field, ..) in fields {
            says += &format!(
                "printf(\"{name}.{field} %u %u\\n\", (unsigned)offsetof(struct {name}, {field}), \
                 (unsigned)sizeof(((const struct {name} *)0)->{field}));\n"
            );
        }
    }
    for counter in Counter::ALL {
        let name = counter.name();
        let word = name.to_uppercase();
        says += &format!("printf(\"{name} %u\\n\", (unsigned)SCANHUB_COUNTER_{word});\n");
    }
    format!("#include <scanhub/attach.h>\n#include <stdio.h>\nint main(void) {{\n{says}return 0;\n}}\n")
}

/// A program that computes what the header does, of 405 beams of `scan`: distance, angle, time.
pub(crate) fn computes(header: &Header, scan: &Scan) -> String {
    let ranges: Vec<String> = scan.range_array.iter().map(u16::to_string).collect();
    let Scan { count, unit_mm, range_bits, first_angle_mdeg, step_mdeg, .. } = scan;
    format!(
        "#include <scanhub/attach.h>\n#include <inttypes.h>\n#include <stdio.h>\n\
         static const uint16_t ranges[401] = {{{}}};\n\
         int main(void) {{\n\
         struct scanhub_header_v1 header = {{0}};\n\
         struct scanhub_scan_v1 scan = {{0}};\n\
         header.stamp_first_ns = {};\n\
         scan.count = {count}; scan.unit_mm = {unit_mm}; scan.range_bits = {range_bits};\n\
         scan.first_angle_mdeg = {first_angle_mdeg}; scan.step_mdeg = {step_mdeg};\n\
         for (unsigned i = 0; i < 401; i++) scan.range_array[i] = ranges[i];\n\
         for (unsigned i = 0; i < 405; i++)\n\
         printf(\"%d %d %\" PRIu64 \"\\n\", (int)scanhub_distance_mm(&scan, i), (int)scanhub_angle_mdeg(&scan, i),\n\
         scanhub_beam_time_ns(&header, &scan, i));\n\
         return 0;\n}}\n",
        ranges.join(","),
        header.stamp_first_ns
    )
}
