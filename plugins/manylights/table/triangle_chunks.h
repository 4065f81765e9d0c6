#pragma once

/**
 * Appends the triangles of a mesh to the table on all threads: each fills chunks of rows, those
 * without power stay out, and the gaps are closed afterwards.
 */

#include "host_table.h"
#include "light_flux.h"

namespace manylights {

/// What became of the triangles of one chunk
struct TriangleChunk {
    uint32_t kept = 0, invalid = 0;
    bool by_plugin = false;
    double flux = 0, largest = 0;
};

/// Move the lights of all chunks together
template <typename Table>
void close_gaps(Table &table, const std::vector<TriangleChunk> &chunks, size_t first,
                size_t primitive, size_t count) {
    size_t end = first;
    for (size_t chunk = 0; chunk < chunks.size(); ++chunk) {
        size_t begin = first + chunk * kChunk, kept = chunks[chunk].kept;
        if (end < begin) {
            std::copy_n(&table.rows[begin], kept, &table.rows[end]);
            std::copy_n(&table.bounds[begin], kept, &table.bounds[end]);
            for (size_t i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk);
                 ++i) {
                uint32_t &light = table.light_of_primitive[primitive + i];
                if (light < kOnlyHit)
                    light -= (uint32_t) (begin - end);
            }
        }
        end += kept;
    }
    table.rows.resize(end);
    table.bounds.resize(end);
}

/// Append rows, bounds and primitives of `count` triangles, each read by
/// `read(index, row, bounds)`; the rest of the bookkeeping is the caller's
template <typename Table, typename F>
std::vector<TriangleChunk> append_triangles(Table &table, size_t count, const F &read) {
    size_t first = table.rows.size(), primitive = table.light_of_primitive.size();
    table.rows.resize(first + count);
    table.bounds.resize(first + count);
    table.light_of_primitive.resize(primitive + count);
    std::vector<TriangleChunk> chunks(chunk_count(count));
    for_chunks(count, [&](size_t number, size_t begin, size_t end) {
        TriangleChunk chunk;
        for (size_t i = begin; i < end; ++i) {
            size_t light        = first + begin + chunk.kept;
            LightRow &row       = table.rows[light];
            LightBounds &bounds = table.bounds[light];
            read(i, row, bounds);
            double power   = usable_power(row, bounds);
            bool kept      = is_valid_power(power) && power > 0,
                 by_plugin = !(row.tag & kTagTabulated);
            chunk.invalid += !is_valid_power(power);
            chunk.flux += kept ? power : 0;
            chunk.largest = std::max(chunk.largest, kept ? power : 0);
            chunk.by_plugin |= by_plugin;
            table.light_of_primitive[primitive + i] =
                kept ? (uint32_t) light : (by_plugin ? kOnlyHit : kNone);
            chunk.kept += kept;
        }
        chunks[number] = chunk;
    });
    close_gaps(table, chunks, first, primitive, count);
    return chunks;
}

} // namespace manylights
