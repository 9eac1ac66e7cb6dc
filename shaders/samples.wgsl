// The pixels of a tile, of which each has one sample or the mean of 2 x 2: the last part of `rasterize`. Twin of
// `TileSums::means` in `src/render/cpu/resolve.rs`.

// Adds the background to the sums of a thread's four pixels or samples, and writes their pixels. The tile begins at
// `corner`. All threads of a tile must call it.
fn finish_tile(index: u32, view: u32, corner: vec2u, thread: u32, sums: Sums) {
    if SAMPLES && has_samples(view) {
        finish_samples(index, view, corner / 2u, thread, sums);
        return;
    }
    let first_pixel = thread_pixel(thread);
    let at_px = vec2f(corner + first_pixel) + 0.5;
    let composed = composite(sums, view, at_px, thread);
    resolve(index, first_pixel.y * TILE_PX + first_pixel.x, composed, instances());
}

// As `finish_tile`, of samples: the first 16 threads have the tile's 8 x 8 pixels, four of a row each. The sums go
// through the memory of the batches, which are done.
fn finish_samples(index: u32, view: u32, corner: vec2u, thread: u32, sums: Sums) {
    workgroupBarrier();
    // Sums of two neighbours of a row.
    mean_factors[thread] = vec4f(pair_sums(sums.red), pair_sums(sums.green));
    mean_factors[THREADS + thread] = vec4f(pair_sums(sums.blue), pair_sums(sums.depth));
    color_depths[thread] = vec4f(pair_sums(sums.transmittance), 0.0, 0.0);
    // Exact: owners have 24 bits.
    color_depths[THREADS + thread] = vec4f(instances());
    workgroupBarrier();
    let pixel = vec2u(thread % 2u * 4u, thread / 2u);
    // The threads of the upper row of samples of the first two pixels, and of the other two; those of the lower row
    // follow them.
    let first = min(pixel.y / 2u * 16u + pixel.x * 2u + pixel.y % 2u * 2u, THREADS - 6u);
    let second = first + 4u;
    let red_green = array(pixel_means(0u, first), pixel_means(0u, second));
    let blue_depth = array(pixel_means(THREADS, first), pixel_means(THREADS, second));
    let through = array(
        color_depths[first] + color_depths[first + 1u],
        color_depths[second] + color_depths[second + 1u],
    );
    let transmittance = 0.25 * vec4f(through[0].xy, through[1].xy);
    var means = Sums(
        vec4f(red_green[0].xy, red_green[1].xy),
        vec4f(red_green[0].zw, red_green[1].zw),
        vec4f(blue_depth[0].xy, blue_depth[1].xy),
        vec4f(blue_depth[0].zw, blue_depth[1].zw),
        // The other threads have no pixels, and show no background.
        select(vec4f(0.0), transmittance, thread < 16u),
    );
    means = composite(means, view, vec2f(corner + pixel) + 0.5, thread);
    if thread < 16u {
        // Tiles of frames with other views, too, have rows of 16 pixels.
        let columns = select(TILE_PX, TILE_PX / 2u, QUARTER_TILES);
        resolve(index, pixel.y * columns + pixel.x, means, sampled_owners(first));
    }
}

fn pair_sums(values: vec4f) -> vec2f {
    return values.xz + values.yw;
}

// The mean of four samples of each of two pixels.
fn pixel_means(values: u32, first: u32) -> vec4f {
    return 0.25 * (mean_factors[values + first] + mean_factors[values + first + 1u]);
}

// The owners of four pixels.
fn sampled_owners(first: u32) -> vec4u {
    if INSTANCE_PLANES == 0u {
        return vec4u(0u);
    }
    let at = THREADS + first;
    let upper = array(vec4u(color_depths[at]), vec4u(color_depths[at + 4u]));
    let lower = array(vec4u(color_depths[at + 1u]), vec4u(color_depths[at + 5u]));
    return vec4u(
        most_frequent_owner(vec4u(upper[0].xy, lower[0].xy)),
        most_frequent_owner(vec4u(upper[0].zw, lower[0].zw)),
        most_frequent_owner(vec4u(upper[1].xy, lower[1].xy)),
        most_frequent_owner(vec4u(upper[1].zw, lower[1].zw)),
    );
}

// The instance and the class that most of four samples have, of equally many the first, each by itself.
fn most_frequent_owner(samples: vec4u) -> u32 {
    return most_frequent(samples & vec4u(0xFFFFu)) | (most_frequent(samples >> vec4u(16u)) << 16u);
}

fn most_frequent(values: vec4u) -> u32 {
    var best = values.x;
    var most = 0u;
    for (var k = 0u; k < 4u; k++) {
        let same = vec4u(values == vec4u(values[k]));
        let count = same.x + same.y + same.z + same.w;
        if count > most {
            most = count;
            best = values[k];
        }
    }
    return best;
}
