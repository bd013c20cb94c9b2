/* Makes the n-th call of a kind fail, among those that touch files below a directory.
 *
 * To be loaded with LD_PRELOAD; armed and asked from within the process, see shim.py. Libraries that are written in C++
 * are hit as well as Python. Kinds: 0 open, 1 write, 2 sync, 3 rename, 4 mkdir.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OPEN, WRITE, SYNC, RENAME, MKDIR, KINDS };

static char root[PATH_MAX];
static atomic_int counts[KINDS];
static atomic_int kind = -1, number, lasting, code, hits;

/* From the number-th call of the kind on (where `lasting`; else that one alone) calls fail; a kind of -1 is none. */
void fault_arm(const char *below, int which, int nth, int stays, int error) {
  kind = -1;
  snprintf(root, sizeof root, "%s", below);
  for (int i = 0; i < KINDS; i++) counts[i] = 0;
  number = nth, lasting = stays, code = error, hits = 0;
  kind = which;
}
void fault_disarm(void) { kind = -1; number = 0; }
int fault_count(int which) { return counts[which]; }
int fault_hits(void) { return hits; }

static int is_below(const char *path) {
  size_t length = strlen(root);
  return length && path && !strncmp(path, root, length) && (path[length] == '/' || !path[length]);
}

static int fails(int which, const char *path) {
  if (!is_below(path)) return 0;
  int now = ++counts[which];
  if (kind != which || (lasting ? now < number : now != number)) return 0;
  hits++;
  errno = code;
  return 1;
}

static const char *of_descriptor(int descriptor, char *into) {
  char name[64];
  snprintf(name, sizeof name, "/proc/self/fd/%d", descriptor);
  ssize_t length = readlink(name, into, PATH_MAX - 1);
  if (length < 0) return NULL;
  into[length] = 0;
  return into;
}

static const char *whole(int directory, const char *path, char *into) {
  char above[PATH_MAX];
  if (!path || path[0] == '/') return path;
  const char *found = directory == AT_FDCWD ? getcwd(above, sizeof above) : of_descriptor(directory, above);
  if (!found || snprintf(into, PATH_MAX, "%s/%s", found, path) >= PATH_MAX) return NULL;
  return into;
}

#define REAL(name) __typeof__(name) *real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)
#define MODE                                        \
  mode_t mode = 0;                                  \
  if (flags & (O_CREAT | __O_TMPFILE)) {            \
    va_list rest;                                   \
    va_start(rest, flags);                          \
    mode = va_arg(rest, mode_t);                    \
    va_end(rest);                                   \
  }

#define OPENS(name)                                               \
  int name(const char *path, int flags, ...) {                    \
    REAL(name);                                                   \
    MODE char buffer[PATH_MAX];                                   \
    if (fails(OPEN, whole(AT_FDCWD, path, buffer))) return -1;    \
    return real(path, flags, mode);                               \
  }
OPENS(open)
OPENS(open64)

#define OPENS_AT(name)                                            \
  int name(int directory, const char *path, int flags, ...) {     \
    REAL(name);                                                   \
    MODE char buffer[PATH_MAX];                                   \
    if (fails(OPEN, whole(directory, path, buffer))) return -1;   \
    return real(directory, path, flags, mode);                    \
  }
OPENS_AT(openat)
OPENS_AT(openat64)

#define ON_DESCRIPTOR(which, result, name, parameters, arguments)      \
  result name parameters {                                             \
    REAL(name);                                                        \
    char buffer[PATH_MAX];                                             \
    if (fails(which, of_descriptor(descriptor, buffer))) return -1;    \
    return real arguments;                                             \
  }
ON_DESCRIPTOR(WRITE, ssize_t, write, (int descriptor, const void *data, size_t size), (descriptor, data, size))
ON_DESCRIPTOR(WRITE, ssize_t, pwrite, (int descriptor, const void *data, size_t size, off_t at), (descriptor, data, size, at))
ON_DESCRIPTOR(WRITE, ssize_t, pwrite64, (int descriptor, const void *data, size_t size, off64_t at), (descriptor, data, size, at))
ON_DESCRIPTOR(WRITE, ssize_t, writev, (int descriptor, const struct iovec *data, int n), (descriptor, data, n))
ON_DESCRIPTOR(WRITE, ssize_t, pwritev, (int descriptor, const struct iovec *data, int n, off_t at), (descriptor, data, n, at))
ON_DESCRIPTOR(SYNC, int, fsync, (int descriptor), (descriptor))
ON_DESCRIPTOR(SYNC, int, fdatasync, (int descriptor), (descriptor))

int rename(const char *from, const char *to) {
  REAL(rename);
  char buffer[PATH_MAX];
  if (fails(RENAME, whole(AT_FDCWD, to, buffer))) return -1;
  return real(from, to);
}
int renameat(int above, const char *from, int directory, const char *to) {
  REAL(renameat);
  char buffer[PATH_MAX];
  if (fails(RENAME, whole(directory, to, buffer))) return -1;
  return real(above, from, directory, to);
}
int mkdir(const char *path, mode_t mode) {
  REAL(mkdir);
  char buffer[PATH_MAX];
  if (fails(MKDIR, whole(AT_FDCWD, path, buffer))) return -1;
  return real(path, mode);
}
