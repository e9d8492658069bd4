# The binary of a functional mock-up unit: make -f fmu.mk NAME=... PART=plant|controller VERSION=2|3
fmu: $(NAME).so

include Makefile

# Of this library the functions of FMI are seen, and nothing else: two of them may be in one process.
SECTIONS += -fvisibility=hidden

$(NAME).so: pcr_fmu.o pcr_fmu_tables.o pcr_fmu_$(PART).o pcr_fmi$(VERSION).o $(OBJECTS)
	$(CC) $(CFLAGS) -shared -s -Wl,--gc-sections $^ -o $@ -lm

.PHONY: fmu
