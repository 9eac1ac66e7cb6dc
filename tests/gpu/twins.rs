//! Constants and layouts are declared both in Rust and in WGSL. These tests parse the WGSL with
//! naga and check that both sides declare the same ones, with equal values, offsets, and sizes.

use std::collections::BTreeMap;

use naga::{Expression, Literal, Module, TypeInner};
use wildcity_render::gpu::layout;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::{MAX_VIEWS, constants};
use wildcity_scene::actor::ContactShadow;
use wildcity_scene::chunk;
use wildcity_scene::sky::SKY_CUT;

/// The shared files: everything that they declare must have a twin in Rust.
fn shared() -> Module {
    let shared = concat!(
        include_str!("../../shaders/shared/constants.wgsl"),
        include_str!("../../shaders/shared/layout.wgsl")
    );
    naga::front::wgsl::parse_str(shared).unwrap()
}

#[test]
fn constants_are_the_same() {
    let rust = BTreeMap::from([
        ("TILE_PX", Literal::U32(constants::TILE_PX)),
        ("BLOCK_PX", Literal::U32(constants::BLOCK_PX)),
        ("EXTENT_SLACK_PX", Literal::F32(constants::EXTENT_SLACK_PX)),
        ("MAX_SIGMA_PX", Literal::F32(constants::MAX_SIGMA_PX)),
        ("DEPTH_BITS", Literal::U32(constants::DEPTH_BITS)),
        ("MAX_VIEWS", Literal::U32(MAX_VIEWS as u32)),
        ("VIEW_BITS", Literal::U32(layout::VIEW_BITS)),
        ("SKY_CUT", Literal::F32(SKY_CUT as f32)),
        ("SHADOW_DEPTH", Literal::F32(ContactShadow::DEPTH)),
        ("SHADOW_FADE_M", Literal::F32(ContactShadow::FADE_M)),
        ("SHADOW_GROUND_M", Literal::F32(ContactShadow::GROUND_M)),
        ("SHADOW_TOP_M", Literal::F32(ContactShadow::TOP_M)),
        ("CLUSTER", Literal::U32(chunk::CLUSTER as u32)),
        ("SOA_BLOCK", Literal::U32(layout::SOA_BLOCK)),
        ("GEOMETRY_WORDS", Literal::U32(layout::GEOMETRY_WORDS)),
        ("WORKGROUP", Literal::U32(layout::WORKGROUP)),
        ("SCAN_BLOCK", Literal::U32(layout::SCAN_BLOCK)),
        ("SORT_BLOCK", Literal::U32(layout::SORT_BLOCK)),
        ("DIGITS", Literal::U32(layout::DIGITS)),
        ("MAX_GROUPS", Literal::U32(layout::MAX_GROUPS)),
        ("RASTER_BATCH", Literal::U32(layout::RASTER_BATCH)),
        ("MACRO_COLUMNS", Literal::U32(layout::MACRO_COLUMNS)),
        ("MACRO_ROWS", Literal::U32(layout::MACRO_ROWS)),
        ("LARGE_SPLAT_MACRO_TILES", Literal::U32(layout::LARGE_SPLAT_MACRO_TILES)),
        ("EXPAND_BATCH", Literal::U32(layout::EXPAND_BATCH)),
    ]);
    let module = shared();
    let wgsl: BTreeMap<&str, Literal> = (module.constants.iter())
        .map(|(_, constant)| {
            let name = constant.name.as_deref().unwrap();
            match module.global_expressions[constant.init] {
                Expression::Literal(literal) => (name, literal),
                ref other => panic!("{name} is {other:?}"),
            }
        })
        .collect();
    assert_eq!(wgsl, rust);
}

/// Name, fields with their offsets, and size of a struct.
type Layout = (String, Vec<(String, usize)>, usize);

macro_rules! layouts {
    ($($name:ident { $($field:ident),+ $(,)? })+) => {
        vec![$((
            stringify!($name).to_owned(),
            vec![$((
                stringify!($field).to_owned(),
                std::mem::offset_of!(layout::$name, $field),
            )),+],
            size_of::<layout::$name>(),
        )),+]
    };
}

#[test]
fn layouts_are_the_same() {
    let mut rust: Vec<Layout> = layouts! {
        FrameView {
            size_px, columns, first_tile, macro_columns, first_macro_tile, rows, native_px2, total_px2,
        }
        Frame {
            splat_capacity, touch_capacity, instance_capacity, views, tiles, macro_tiles, near_m, far_m,
            antialiased, alpha_cap, log2_alpha_cut, stop, batch_limit, long_tile_splats, long_tiles, sampled, view,
        }
        Background {
            scale, offset, edge, width, octaves, encoded, identity, skip, sky_from_pixel,
        }
        CameraAppearance { exposure, overlay_px, first_overlay, has_exposure }
        ChunkView {
            camera_from_chunk, depth_high, depth_low, camera_m, view, focal_px, center_px, slope_min, slope_max,
        }
        Lens {
            center_px, model, windshield, linear, end, end_value, end_slope, end_rad, widest_rad, by_distance,
            non_pinhole, pad0, coefficients, windshield_shift, remaining_exposure, moved_m, pad1,
            moved_world_m, pad2, axis_angle, expansion,
        }
        ChunkLight { tint, first_shadow, shadows, pad0, pad1, pad2 }
        ChunkShadow { actor_from_chunk, half_m, pad }
        ClusterView { line, chunk_view }
        Owner { cluster_view, instance }
        Span { first, count }
        MacroRun {
            first_macro_tile, macro_tiles, tiles, continues, first_touch, touches, first_instance,
            first_batch, batches, first_tile,
        }
        Job { length, groups }
        JobSlot { job, pad }
        Counters { splats, touches, instances }
        TileCounters { block_pairs, most_batches }
        SplatShape { mean_px, extent_px, factor, log2_opacity }
        SplatColor { rgb, depth_m }
    };
    let module = shared();
    let structs = module.types.iter().filter_map(|(_, ty)| {
        let TypeInner::Struct { members, span } = &ty.inner else { return None };
        let field = |m: &naga::StructMember| (m.name.clone().unwrap(), m.offset as usize);
        Some((ty.name.clone().unwrap(), members.iter().map(field).collect(), *span as usize))
    });
    let mut wgsl: Vec<Layout> = structs.collect();
    rust.sort();
    wgsl.sort();
    assert_eq!(wgsl, rust);
}

#[test]
fn every_shader_is_valid_and_linked() {
    for (name, source) in Shaders::default().stages() {
        assert!(!source.contains("#import"), "{name}: an import was not found");
        let module = naga::front::wgsl::parse_str(source)
            .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(source)));
        let everything = naga::valid::Capabilities::all();
        naga::valid::Validator::new(naga::valid::ValidationFlags::all(), everything)
            .validate(&module)
            .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(source)));
    }
}
