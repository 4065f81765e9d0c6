#pragma once

/// Arrays of kernels, written on the host.

#include "host_memory.h"
#include "host_view.h"

namespace manylights {

/// Memory on the host that is filled or changed there and becomes an array for kernels
template <typename Storage> class HostStorage {
public:
    using Value = dr::scalar_t<Storage>;

    /// Memory for `size` numbers, not initialized
    Value *allocate(size_t size) {
        if constexpr (dr::is_cuda_v<Storage>) {
            m_copy.resize(size);
            return m_copy.data();
        } else {
            m_array = dr::empty<Storage>(size);
            return host_data();
        }
    }

    /// The numbers of an array, which is taken away. They are copied if kernels that have
    /// not run yet need the array as it is
    Value *open(Storage &array) {
        if constexpr (dr::is_cuda_v<Storage>) {
            HostView view(array);
            m_copy.assign(view.data(), view.data() + view.size());
            return m_copy.data();
        } else {
            m_array = std::move(array);
            if constexpr (dr::is_jit_v<Storage>)
                if (jit_var_ref(m_array.index()) > 1)
                    m_array = dr::load<Storage>(HostView(m_array).data(), m_array.size());
            return host_data();
        }
    }

    Storage close() {
        if constexpr (dr::is_cuda_v<Storage>)
            return dr::load<Storage>(m_copy.data(), m_copy.size());
        else
            return std::move(m_array);
    }

private:
    Value *host_data() {
        Value *data = m_array.data();
        // Kernels that run may still use this memory
        if constexpr (dr::is_jit_v<Storage>)
            dr::sync_thread();
        return data;
    }

    Storage m_array;
    HostVector<Value> m_copy;
};

} // namespace manylights
