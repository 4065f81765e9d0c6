#pragma once

/**
 * Single numbers in the memory of a GPU, which is where the parameters of emitters are: read
 * all at once. One at a time each waits for the GPU, some 10 us: 3 s for 100,000 points.
 */

#include <drjit-core/jit.h>
#include <drjit/array_traits.h>
#include <unordered_map>
#include <vector>

namespace manylights {

namespace dr = drjit;

/// Values of variables with one entry, on the host. They are found by this thread while the
/// object lives. Does nothing in variants that have no need of it
template <typename Float> class DeviceScalars {
public:
    explicit DeviceScalars(const std::vector<uint32_t> &variables) {
        if constexpr (dr::is_cuda_v<Float>) {
            copy(variables);
            current = this;
        }
    }
    ~DeviceScalars() { current = nullptr; }
    DeviceScalars(const DeviceScalars &) = delete;

    /// The value of a variable, null if it was not read in advance
    static const float *find(uint32_t variable) {
        if (!current)
            return nullptr;
        auto it = current->m_places.find(variable);
        return it == current->m_places.end() ? nullptr : &current->m_values[it->second];
    }

private:
    void copy(const std::vector<uint32_t> &variables) {
        if (variables.empty())
            return;
        constexpr JitBackend backend = JitBackend::CUDA;
        auto *sources                = (AggregationEntry *) jit_malloc(
            backend, variables.size() * sizeof(AggregationEntry), /* shared = */ 1);
        uint32_t count = 0;
        m_places.reserve(variables.size());
        for (uint32_t variable : variables) {
            VarInfo info = jit_set_backend(variable);
            if (info.state == VarState::Evaluated && info.type == VarType::Float32 &&
                info.size == 1 && m_places.emplace(variable, count).second) {
                uint32_t offset = count * (uint32_t) sizeof(float);
                // A negative size: the address of a value, and not a value
                sources[count++] = { -(int16_t) sizeof(float), 0, offset, info.data };
            }
        }
        m_values.resize(count);
        if (count > 0) {
            void *values = jit_malloc(backend, count * sizeof(float));
            jit_aggregate(backend, values, sources, count);
            jit_memcpy(backend, m_values.data(), values, count * sizeof(float));
            jit_free(values);
        }
        jit_free(sources);
    }

    std::unordered_map<uint32_t, uint32_t> m_places; // into `m_values`
    std::vector<float> m_values;

    static inline thread_local const DeviceScalars *current = nullptr;
};

} // namespace manylights
