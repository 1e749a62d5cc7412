//! Layouts of all payloads in C, and generated C programs. The programs print the layouts of the C header, or the
//! values that it computes from a scan.

use scanhub_schema::{ArrayFlags, Counter, Family, Header, Scan, ScanHead};

struct Layout {
    /// Name in C.
    name: String,
    /// Size in bytes.
    size: usize,
    /// Name, offset and size in bytes of each field.
    fields: Vec<(String, usize, usize)>,
}

/// Returns the layouts of `tests/vectors/v2/layouts.txt`, which come from the Rust structs.
fn layouts() -> Vec<Layout> {
    let mut layouts: Vec<Layout> = Vec::new();
    for line in include_str!("../../vectors/v2/layouts.txt").lines().filter(|line| !line.starts_with("    "))
    {
        let words: Vec<&str> = line.split_whitespace().collect();
        let number: usize = words[1].parse().expect("a number");
        match layouts.last_mut().filter(|_| line.starts_with(' ')) {
            None => {
                let rust = words[0].split('.').nth(1).expect("a name");
                let mut name = "scanhub".to_owned();
                for letter in rust.strip_suffix("Head").unwrap_or(rust).chars() {
                    name.extend(letter.is_uppercase().then_some('_'));
                    name.extend(letter.to_lowercase());
                }
                layouts.push(Layout { name: name + "_v2", size: number, fields: Vec::new() });
            }
            Some(layout) => {
                if let Some((_, at, size)) = layout.fields.last_mut() {
                    *size = number - *at;
                }
                layout.fields.push((words[0].to_owned(), number, layout.size - number));
            }
        }
    }
    layouts
}

/// Returns the lines that the program of [`program`] must print.
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

/// Returns a program in C or C++ that prints the size of each payload, the offset and size of each of its fields, and
/// the indexes of the counters.
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

/// Returns scans of all kinds: LMS scans in each mode, revolutions with all arrays, revolutions without arrays, and an
/// empty scan.
pub(crate) fn scans() -> Vec<Box<Scan>> {
    let ranges = |count: u32, greatest: u32| -> Vec<u16> {
        (0..count).map(|i| (greatest - (i * 3) % 40) as u16).collect()
    };
    let lms = |count: u16, bits, step_mdeg, unit_mm| {
        let head = ScanHead::lms(count.into(), -50_000, step_mdeg, unit_mm, bits);
        Scan::of(ScanHead { intensity_bits: bits - 13, ..head }, &ranges(count.into(), (1 << bits) - 1))
    };
    let mut scans = vec![lms(361, 13, 500, 1), lms(181, 14, 1000, 10), lms(401, 15, 250, 100)];
    for contents in
        [0, ArrayFlags::UPPER, ArrayFlags::WIDE, ArrayFlags::ANGLES | ArrayFlags::WIDE, ArrayFlags::ALL]
    {
        let head = ScanHead {
            first_angle: 3.0,
            step: -0.0125,
            beam_time_ns: 222_222,
            first_beam_ns: -99_999_999,
            unit_um: 250,
            valid_to: 0xFFEF,
            collisions: 7,
            family: Family::Ld as u8,
            flags: Scan::INCOMPLETE,
            contents,
            intensity_bits: 8,
            ..ScanHead::default()
        };
        let mut scan = Scan::of(head, &ranges(450, 0xFFFF));
        let arrays = scan.arrays();
        for (i, angle) in arrays.angles.iter_mut().enumerate() {
            *angle = if i % 9 == 0 { f32::NAN } else { i as f32 / 100.0 };
        }
        arrays.wide.iter_mut().zip(1..).for_each(|(wide, i)| *wide = 100 * i);
        arrays.upper.iter_mut().zip(1..).for_each(|(upper, i): (_, u16)| *upper = (i % 251) as u8);
        scans.push(scan);
    }
    scans.push(Scan::of(ScanHead::default(), &[]));
    scans
}

/// Returns a C program that prints the values that the header computes for each beam of `scan` and for three beam
/// indexes after the last one. The program also checks that the header reads nothing outside of an invalid or a
/// truncated sample.
pub(crate) fn computed_values_c(header: &Header, scan: &Scan) -> String {
    let bytes = scan.bytes();
    let list: Vec<String> = bytes.iter().map(u8::to_string).collect();
    format!(
        "#include <scanhub/attach.h>\n#include <inttypes.h>\n#include <stdio.h>\n#include <stdlib.h>\n#include <string.h>\n\
         static const unsigned char bytes[] = {{{}}};\n\
         int main(void) {{\n\
         struct scanhub_header_v2 header = {{0}};\n\
         struct scanhub_sample sample = {{0}};\n\
         void *memory = malloc(sizeof bytes);\n\
         if (scanhub_count(&sample) != 0 || !isnan(scanhub_range_m(&sample, 0)) || scanhub_code(&sample, 0) != NULL\n\
             || scanhub_beam_stamp_ns(&sample, 0) != 0 || scanhub_background_ranges(&sample) != NULL\n\
             || scanhub_segments(&sample) != NULL || scanhub_in_foreground(&sample, 0)\n\
             || scanhub_has_support(&sample, 0)) return 1;\n\
         memcpy(memory, bytes, sizeof bytes);\n\
         header.stamp_first_ns = {};\n\
         sample.header = &header; sample.payload = memory;\n\
         sample.length = 64 + (sizeof bytes - 64) / 2;\n\
         if (scanhub_count(&sample) > {} / 2) return 2;\n\
         sample.length = sizeof bytes;\n\
         printf(\"%u %u %d\\n\", scanhub_count(&sample), scanhub_collisions(&sample), scanhub_is_incomplete(&sample));\n\
         for (unsigned i = 0; i < scanhub_count(&sample) + 3; i++) {{\n\
         const char *code = scanhub_code(&sample, i);\n\
         printf(\"%.17g %.17g %s %d %\" PRIu64 \"\\n\", scanhub_range_m(&sample, i), scanhub_angle(&sample, i),\n\
         code == NULL ? \"reading\" : code, (int)scanhub_intensity(&sample, i), scanhub_beam_stamp_ns(&sample, i));\n\
         }}\n\
         free(memory);\n\
         return 0;\n}}\n",
        list.join(","),
        header.stamp_first_ns,
        scan.beams()
    )
}
