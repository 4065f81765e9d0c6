#pragma once

/**
 * Large arrays on the host, and loops over them on all threads. Plain C++, no Dr.Jit.
 */

#include <algorithm>
#include <cstddef>
#include <memory>
#include <nanothread/nanothread.h>
#include <utility>
#include <vector>

namespace manylights {

/// Leaves the entries of a vector uninitialized: large ones are filled on all threads
template <typename T> struct UninitializedAllocator : std::allocator<T> {
    template <typename U> struct rebind {
        using other = UninitializedAllocator<U>;
    };
    template <typename U> void construct(U *place) { ::new ((void *) place) U; }
    template <typename U, typename... Args> void construct(U *place, Args &&...args) {
        ::new ((void *) place) U(std::forward<Args>(args)...);
    }
};

template <typename T> using HostVector = std::vector<T, UninitializedAllocator<T>>;

/// Entries of an array that one task handles. Fixed, so that nothing depends on the number
/// of threads
constexpr size_t kChunk = 1 << 14;

inline size_t chunk_count(size_t size, size_t chunk = kChunk) {
    return (size + chunk - 1) / chunk;
}

/// Call f(index of the chunk, begin, end) for all chunks of an array, at the same time
template <typename F> void for_chunks(size_t size, const F &f, size_t chunk = kChunk) {
    auto run     = [&](size_t i) { f(i, i * chunk, std::min(size, (i + 1) * chunk)); };
    size_t count = chunk_count(size, chunk);
    if (count <= 1)
        return count == 1 ? run(0) : void();
    drjit::parallel_for(drjit::blocked_range<size_t>(0, count), [&](const auto &range) {
        for (size_t i : range)
            run(i);
    });
}

} // namespace manylights
