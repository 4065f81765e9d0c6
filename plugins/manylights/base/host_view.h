#pragma once

/// Arrays of kernels, read on the host.

#include <drjit/jit.h>
#include <type_traits>

namespace manylights {

namespace dr = drjit;

/// A buffer as it lies in memory; a copy only if that is a GPU's
template <typename Buffer> class HostView {
public:
    using T = dr::scalar_t<Buffer>;

    explicit HostView(const Buffer &buffer) : m_size(dr::width(buffer)) {
        if (m_size == 0)
            return;
        if constexpr (dr::is_jit_v<Buffer>) {
            m_kept = dr::detach<false>(buffer);
            if constexpr (dr::is_cuda_v<Buffer>)
                m_kept = dr::migrate(m_kept, JitBackend::None);
            m_data = m_kept.data();
            dr::sync_thread();
        } else {
            m_data = buffer.data();
        }
    }
    const T *data() const { return m_data; }
    size_t size() const { return m_size; }
    const T &operator[](size_t i) const { return m_data[i]; }

private:
    struct Nothing {};
    std::conditional_t<dr::is_jit_v<Buffer>, dr::detached_t<Buffer>, Nothing> m_kept;
    const T *m_data = nullptr;
    size_t m_size;
};

} // namespace manylights
