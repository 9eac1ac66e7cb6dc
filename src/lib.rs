//! `wildcity`: a closed-loop driving simulator server for city twins made of 3D Gaussians.
//!
//! This package is the command line. The work is done by the packages of the workspace, each of
//! which names only those below it; Cargo holds them to this table, and `tests/tidy` holds the
//! table to the manifests.
//!
//! | package | what it is | depends on |
//! |---|---|---|
//! | [`wildcity_options`] | the options of a session, as the wire and files have them | nothing of ours |
//! | [`wildcity_protocol`] | the wire: messages, schemas, binary observations | options |
//! | [`wildcity_client`] | the Rust client of the protocol | protocol |
//! | [`wildcity_scene`] | what a twin is: geometry, cameras, Gaussians, levels of detail, skies, drives | options |
//! | [`wildcity_render`] | images of a scene: `reference` (f64), `cpu` (SIMD), `gpu` (wgpu) | scene |
//! | [`wildcity_heap`] | gives free memory back to the operating system | nothing of ours |
//! | [`wildcity_generate`] | procedural streets and cities, and their maps | scene, sim |
//! | [`wildcity_sim`] | what moves: ego, traffic, contacts; scenarios, maps and routes | options, scene |
//! | [`wildcity_convert`] | maps and scenarios from OpenDRIVE, GeoJSON and OpenSCENARIO | options, scene, sim |
//! | [`wildcity_log`] | recorded drives on disk: images, LiDAR, poses, tracks, map, with their times | options, scene, sim |
//! | [`wildcity_score`] | scores of driven episodes: other projects', and our verdict | scene, sim |
//! | [`wildcity_episode`] | recorded episodes: their lines, reading, scoring and comparing them | scene, score, sim |
//! | [`wildcity_augment`] | views off the drive as training data: plan, masks, transforms.json, COLMAP, resume | client, scene, session, twin |
//! | [`wildcity_eval`] | rendered images against held-out real ones: scores and their page | augment, client, log, render, repair, scene, session, twin |
//! | [`wildcity_train`] | training on images: losses, gradients against their definition | render, scene |
//! | [`wildcity_stress`] | extreme scenes, each with its bound, for every backend | generate, render, scene |
//! | [`wildcity_twin`] | twins on disk and in memory: import, versioned store, streaming | options, scene |
//! | [`wildcity_session`] | episodes: reset, step, observe, record, replay | episode, generate, options, render, repair, scene, sim, twin |
//! | [`wildcity_push`] | new versions from uploaded files: read, check, report, preview, publish | render, scene, session, twin |
//! | [`wildcity_repair`] | repair of images by an ONNX model: manifest, tiles, checks, hashes | scene |
//! | [`wildcity_report`] | error against run time of every setting of a twin | generate, render, repair, scene, session, stress, twin |
//! | [`wildcity_alpasim`] | AlpaSim's gRPC services | client, options, render, scene, session, sim, twin |
//! | [`wildcity_server`] | WebSocket and HTTP, and the viewer | episode, heap, options, protocol, push, render, repair, scene, session, sim, twin |
//! | [`wildcity_bench`] | the program `wildcity-bench`: speed of steps, sessions, actors and loading | client, generate, heap, protocol, render, scene, server, session, twin |
//! | [`wildcity_suite`] | suites of scenarios: drives, judges and reports them | episode, render, scene, score, server, session, sim, twin |
//!
//! Data goes one way: file, twin, render, session, server, agent. An agent's pose or action goes
//! server, session, sim. No package calls one above it.
//!
//! # Invariants
//!
//! 1. Only `protocol`, `client`, `server::convert` and `server::fault` use the messages of the
//!    wire.
//! 2. Only `twin::store` opens files of a twin; only `render::gpu` names wgpu; only `server` names
//!    axum; only `repair::onnx` names the ONNX runtime; only `alpasim` names tonic and prost; only
//!    `heap` has `unsafe`.
//! 3. `scene`, `render` and `sim` are pure: the same input gives the same bytes at any thread
//!    count.
//! 4. Scene data is checked once, when it enters; poses and cameras are checked once, at
//!    the wire or by the session that is opened with them.
//! 5. An image is a function of scene version, render profile, actors, and its own camera and pose;
//!    and, where it says so, of the repair model's hash and the episode's history; and of the
//!    effects of sensors, which a seed, a name and a time decide. Caches, batches and the other
//!    cameras of a frame change latency, never pixels.
//! 6. Every observation names the scene version and the render profile that it was made with. A new
//!    version becomes visible only between two steps, and only to a session that asked for it.
//! 7. Time is integer microseconds; poses are f64 until the renderer makes them camera-relative
//!    f32.
//! 8. Every queue, message, buffer and count has a maximum, in the `limits` module of its package.
//! 9. A scene pays only for what it has: without a sky, spherical harmonics, lenses, actors, repair
//!    or effects of sensors there is no buffer, pass, pipeline or library for them.
//! 10. One table maps each fault to its wire code and its HTTP status, exhaustively.
//!
//! [`wildcity_bench`]: ../wildcity_bench/index.html
//! [`wildcity_heap`]: ../wildcity_heap/index.html
//! [`wildcity_options`]: ../wildcity_options/index.html
//! [`wildcity_score`]: ../wildcity_score/index.html

pub mod cli;
