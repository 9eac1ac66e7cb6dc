//! Decompression bombs: small files whose decompressed content is large.

use std::io::{Cursor, Write};
use std::process::Command;

use crate::format_files::{glb, gltf, sog, zip};
use crate::scene_files::gaussians;

/// Gaussians of the valid file that is turned into a decompression bomb.
const COUNT: usize = 6;

/// Compressed zeros, which take seconds to compress.
struct Zeros {
    /// A raw DEFLATE stream.
    deflated: Vec<u8>,
    crc: flate2::Crc,
}

impl Zeros {
    fn new(mib: u32) -> Self {
        let mut encoder =
            flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::best());
        let mut crc = flate2::Crc::new();
        let zeros = vec![0; 1 << 20];
        for _ in 0..mib {
            encoder.write_all(&zeros).unwrap();
            crc.update(&zeros);
        }
        Self { deflated: encoder.finish().unwrap(), crc }
    }

    /// A gzip stream of a few bytes, in a stored block, and of these zeros.
    fn after(&self, start: &[u8]) -> Vec<u8> {
        let length = u16::try_from(start.len()).unwrap();
        let mut crc = flate2::Crc::new();
        crc.update(start);
        crc.combine(&self.crc);
        [
            &[0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 2, 255, 0][..],
            &length.to_le_bytes(),
            &(!length).to_le_bytes(),
            start,
            &self.deflated,
            &crc.sum().to_le_bytes(),
            &crc.amount().to_le_bytes(),
        ]
        .concat()
    }
}

/// A lossless WebP image of equal pixels. Each of its five prefix codes has one symbol, which takes
/// no bits.
fn webp_of_one_color(side_px: u64, [red, green, blue, alpha]: [u8; 4]) -> Vec<u8> {
    // Value and number of bits: the size, alpha and the version; neither transforms nor caches nor
    // further codes.
    let header = [(side_px - 1, 14), (side_px - 1, 14), (1, 1), (0, 3), (0, 3)];
    // A simple code, of one symbol, of eight bits.
    let code = |symbol: u8| (0b101 | u64::from(symbol) << 3, 11);
    let codes = [code(green), code(red), code(blue), code(alpha), code(0)];
    let (mut word, mut used) = (0u128, 0);
    for (value, bits) in header.into_iter().chain(codes) {
        word |= u128::from(value) << used;
        used += bits;
    }
    let stream = [&[0x2f][..], &word.to_le_bytes()[..12]].concat();
    assert!(used <= 8 * 12);
    let length = u32::try_from(stream.len()).unwrap();
    let padded = length + length % 2;
    let mut file = [&b"RIFF"[..], &(12 + padded).to_le_bytes(), b"WEBPVP8L"].concat();
    file.extend(length.to_le_bytes());
    file.extend(stream);
    file.resize(20 + padded as usize, 0);
    file
}

/// Decompression bombs are refused because of the sizes that they declare, or as soon as a limit is
/// reached. Each is read by a process of its own, whose memory stays bounded.
#[test]
fn decompression_bombs_are_refused_in_bounded_memory() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| std::fs::write(dir.path().join(name), bytes).unwrap();
    // 512 MiB of zeros in 0.5 MB: with a header that declares their size, and with one that
    // declares none.
    let zeros = Zeros::new(512);
    let nothing = |start: &[u8]| zeros.after(start);
    let header = |count: u32| {
        let count = count.to_le_bytes();
        [&b"NGSP\x03\x00\x00\x00"[..], &count, &[0, 12, 0, 0]].concat()
    };
    write("honest.spz", &nothing(&header((512 << 20) / 20)));
    write("sly.spz", &nothing(&header(0)));
    write("payload.usdz", &zip(&[("x.nurec".into(), nothing(b""))], false));
    let big = vec![0; 256 << 20];
    write(
        "means.zip",
        &zip(
            &{
                let mut files = sog(&gaussians(COUNT, 0, 20.0, 1), 2);
                files[1].1 = big;
                files
            },
            true,
        ),
    );
    // An image of 8,192 x 8,192 equal pixels: 256 MiB in a few bytes; and six of them.
    let image = webp_of_one_color(8192, [128, 128, 128, 255]);
    let decoded = image_webp::WebPDecoder::new(Cursor::new(&image)).unwrap().dimensions();
    assert_eq!(decoded, (8192, 8192));
    let mut files = sog(&gaussians(COUNT, 0, 20.0, 1), 2);
    files[1..].iter_mut().for_each(|file| file.1 = image.clone());
    let meta = String::from_utf8(files[0].1.clone()).unwrap();
    files[0].1 = meta.replace(r#""count":6"#, r#""count":67108864"#).into_bytes();
    write("images.sog", &zip(&files, false));
    // A thousand nodes show one mesh.
    let (json, buffer) = gltf(&gaussians(20_000, 3, 20.0, 1), "", "");
    let nodes = vec![r#"{"mesh":0}"#; 1000].join(",");
    let shown: Vec<String> = (0..1000).map(|node| node.to_string()).collect();
    let json = json.replacen(r#"[{"mesh":0}]"#, &format!("[{nodes}]"), 1);
    let json =
        json.replacen(r#"{"nodes":[0]}"#, &format!(r#"{{"nodes":[{}]}}"#, shown.join(",")), 1);
    write("instances.glb", &glb((json, buffer)));
    // 5 kB name one file of 64 MiB two hundred times; the last time with one byte more than it has.
    std::fs::File::create(dir.path().join("big.bin")).unwrap().set_len(64 << 20).unwrap();
    let named = |bytes: u64| format!(r#"{{"uri":"big.bin","byteLength":{bytes}}}"#);
    let buffers = [vec![named(1); 199], vec![named((64 << 20) + 1)]].concat().join(",");
    let json = format!(r#"{{"asset":{{"version":"2.0"}},"buffers":[{buffers}]}}"#);
    write("named.gltf", json.as_bytes());

    for (name, wanted, limit_mb) in [
        ("honest.spz", "SPZ, the gzip stream: ", 60),
        ("sly.spz", "SPZ body, the end: more than the 16 bytes", 60),
        ("payload.usdz", "NuRec, the gzip stream: ", 250),
        ("means.zip", "zip, means_l.webp: ", 60),
        ("images.sog", "SOG, means_l.webp: ", 60),
        ("instances.glb", "glTF, node ", 700),
        ("named.gltf", "glTF body: the header promises 67108865 bytes (buffer 199)", 150),
    ] {
        let path = dir.path().join(name);
        let file_mb = std::fs::metadata(&path).unwrap().len() >> 20;
        assert!(file_mb < 6, "{name} is {file_mb} MB: no bomb");
        // The shell sets a limit of address space, which bounds resident memory.
        let import = Command::new("sh")
            .args(["-c", r#"ulimit -v "$1"; exec "$2" import "$3" --twin bomb --twins "$4""#, "sh"])
            .arg(((limit_mb + 150) << 10).to_string())
            .arg(env!("CARGO_BIN_EXE_wildcity"))
            .arg(&path)
            .arg(dir.path().join("twins"))
            .env("RAYON_NUM_THREADS", "2")
            .env("MALLOC_ARENA_MAX", "1")
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&import.stderr);
        assert_eq!(import.status.code(), Some(1), "{name}: {said}");
        assert!(said.contains(wanted), "{name}: {said}");
    }
}
